"""What was photographed: cameras, views, scenes, and the readers that load them. Imports neither torch nor warp."""

from .camera import Camera, look_at
from .camera_files import load_cameras
from .develop import develop
from .load import choose_response, embedded_folder, embedded_scenes, is_embedded, load_scene, read_capture
from .types import Scene, View, codes_of, encoded_values

__all__ = [
    "Camera",
    "Scene",
    "View",
    "choose_response",
    "codes_of",
    "develop",
    "embedded_folder",
    "embedded_scenes",
    "encoded_values",
    "is_embedded",
    "load_cameras",
    "load_scene",
    "look_at",
    "read_capture",
]
