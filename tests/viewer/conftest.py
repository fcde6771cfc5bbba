"""A server over an analytic scene, on a free port."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.viewer.server import Server, Viewer
from sehdr_warp.viewer.viewer_scene import ViewerScene
from tests.output.helpers import make

from ..output.helpers import AnalyticRun


@contextmanager
def serving(viewer: Viewer, port: int) -> Iterator[Server]:
    """A server of a viewer that answers until the end of the block."""
    with Server(viewer, port=port) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        try:
            yield server
        finally:
            server.shutdown()


@pytest.fixture
def serve(tmp_path):
    """serve(**options) starts a server of two runs with photos, and returns it."""
    servers = ExitStack()

    def start(count=1, photos=None, **options):
        run, scene = make(tmp_path)
        run.field = SimpleNamespace(render_mean=lambda camera, values: torch.full((camera.height, camera.width), 0.25))
        runs = [run, AnalyticRun()][:count]
        scenes = [ViewerScene(each, f"run {i}", torch.ones(1) if i == 0 else None) for i, each in enumerate(runs)]
        photos = photos or (lambda index: {view.name: view for view in scene.views})
        viewer = Viewer(scenes, photos, **options)
        return servers.enter_context(serving(viewer, 18080))

    with servers:
        yield start
