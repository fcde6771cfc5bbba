"""What was photographed: cameras, views, scenes, and the readers that load them. Imports neither torch nor warp."""

from .camera import Camera
from .types import Scene, View

__all__ = ["Camera", "Scene", "View"]
