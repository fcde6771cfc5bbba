"""Cameras, views, scenes, and the readers that load them from photos. Imports neither torch nor warp."""

from .camera import Camera, look_at
from .camera_files import load_cameras
from .load import embedded_folder, embedded_scenes, is_embedded, load_scene, parse_dataset
from .preprocess import preprocess
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
    "preprocess",
]
