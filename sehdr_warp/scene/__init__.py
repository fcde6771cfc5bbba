"""Cameras, views, scenes, and the readers that load them from photos. Imports neither torch nor warp.

load.py leads from a data folder to a Scene (types.py). In the order of its work:

- readers/: a dataparser for each layout, whose result (dataparser.py) is photos, cameras and points.
- masks.py, truth_files.py, unused_files.py, file_names.py: which file belongs to which photo.
- sfm/: cameras of bare photos by structure from motion. camera*.py, lens.py, wide_camera.py: cameras and their lenses.
- exposure/: exposure times, and what a camera changed without stating it.
- images/, raw/, video/: decoders, metadata and gain maps. photos.py chooses among them.
- color/, response_choice.py: colors that files state, and the camera's response.
- preprocess.py, photo_storage.py: views, undistorted and resized in linear light, in memory or on the disk.
"""

from .camera import Camera, look_at
from .load import embedded_folder, embedded_scenes, is_embedded, load_scene, parse_dataset
from .readers.camera_files import load_cameras
from .types import Scene, View, codes_of, encoded_values

__all__ = [
    "Camera",
    "Scene",
    "View",
    "codes_of",
    "embedded_folder",
    "embedded_scenes",
    "encoded_values",
    "is_embedded",
    "load_cameras",
    "load_scene",
    "look_at",
    "parse_dataset",
]
