import json
import threading

import numpy as np
import pytest

from sehdr_warp.output.world_transform import world_transform
from sehdr_warp.viewer.frames import ViewerScene
from sehdr_warp.viewer.server import Server, Viewer

from ..output.test_splat_edits import run_of, splats
from .test_server import ask, frame


@pytest.fixture
def server(tmp_path):
    """A viewer of two Gaussians, in a folder that keeps an orientation."""
    run = run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0)], [0.9, 0.9]))
    run.path = tmp_path
    server = Server(Viewer([ViewerScene(run, "run")]), port=18400)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def edit(server, **request):
    status, _, content = ask(server, "/edit", request)
    return status, json.loads(content) if status == 200 else content.decode()


def test_a_crop_is_shown_and_undone(server):
    scene = server.viewer.runs[0]
    view, version = scene.cameras[1].camera, scene.version
    before = frame(server, view)[0]
    x, y, z = world_transform(scene).points(np.array([1.0, 0, 0]))
    status, facts = edit(server, cut=f"sphere:{x},{y},{z},0.2")
    assert status == 200 and facts["gaussians"] == 1 and facts["edited"] and facts["version"] > version
    assert not np.allclose(frame(server, view)[0], before)
    status, words = edit(server, crop="sphere:99,0,0,1")
    assert status == 409 and "leave no Gaussian" in words
    assert edit(server, crop="ball")[0] == 409
    status, facts = edit(server)
    assert facts["gaussians"] == 2 and not facts["edited"]
    np.testing.assert_array_equal(frame(server, view)[0], before)


def test_up_and_scale_are_kept_with_the_run(server, tmp_path):
    status, _, content = ask(server, "/orientation", {"up": [0, 0, 1]})
    assert status == 200 and np.allclose(np.array(json.loads(content)["upright"])[1, :3], [0, 0, 1])
    assert ask(server, "/orientation", {"scale": 0.25})[0] == 200
    kept = json.loads((tmp_path / "orientation.json").read_text())
    assert kept == {"up": [0, 0, 1], "scale": 0.25}
    for request in ({"scale": -1}, {"up": [0, 0, 0]}, {"up": [1]}):
        assert ask(server, "/orientation", request)[0] == 409
    assert json.loads((tmp_path / "orientation.json").read_text()) == kept


def test_a_page_to_share_is_saved(server):
    view = server.viewer.runs[0].cameras[0].camera.to_dict()
    status, kind, page = ask(server, "/save", {"kind": "page", "cameras": [view]})
    assert (status, kind) == (200, "text/html") and b"</html>" in page
