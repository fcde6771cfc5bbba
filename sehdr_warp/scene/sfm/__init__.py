"""Structure from motion through pycolmap: cameras and points of bare photos and panoramas."""
