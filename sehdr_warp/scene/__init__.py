"""What was photographed: cameras, views, scenes, and the readers that load them. Imports neither torch nor warp."""

from .camera import Camera, look_at
from .camera_path import load_cameras
from .load import embedded_names, is_embedded, load_scene
from .types import Scene, View

__all__ = ["Camera", "Scene", "View", "embedded_names", "is_embedded", "load_cameras", "load_scene", "look_at"]
