"""Long life: what a process does many times takes hardly more memory in the end than at a fifth of it."""

import gc
import http.client
import json
import resource
import threading
from contextlib import chdir
from pathlib import Path

import pytest

from sehdr_warp import cli
from sehdr_warp.runs.run import load_run
from sehdr_warp.viewer.server import Server, Viewer
from sehdr_warp.viewer.viewer_scene import ViewerScene

from .harness import COMMANDS, TRAIN

pytestmark = pytest.mark.trial
FRAMES, FRAMES_EACH = 5 * 3600, 90  # An hour at five frames a second, of clients that come, look for so many, and go


@pytest.fixture
def live(record_property):
    """live(act, count, most): does act(number) so often; it may take so many MiB from a fifth of them on."""

    def run(act, count: int, most: float) -> None:
        early = 0.0
        for number in range(count):
            act(number)
            if number in (count // 5, count - 1):
                gc.collect()
                pages = int(Path("/proc/self/statm").read_text().split()[1])
                early, late = early or pages, pages
        memory = [round(each * resource.getpagesize() / 2**20, 1) for each in (early, late)]
        record_property("memory", "{} to {}".format(*memory))
        assert memory[1] <= memory[0] + most, memory

    return run


def command(folder: Path, *words: str) -> None:
    with chdir(folder), pytest.raises(SystemExit) as end:
        cli.main([*words, "-q"])
    assert end.value.code == 0


def test_200_renders(space, live):
    live(lambda number: command(space, *COMMANDS["render"]), 200, most=8)


def test_50_trainings(space, live):
    live(lambda number: command(space, *TRAIN, "--overwrite"), 50, most=12)


def test_an_hour_of_the_viewer(space, live):
    run = load_run(space / "run")
    body = json.dumps({"camera": run.cameras[0].camera.to_dict()})

    def look(number: int) -> None:
        client = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=60)
        for _ in range(FRAMES_EACH):
            client.request("POST", "/frame", body, {"Content-Type": "application/json"})
            assert len(client.getresponse().read()) > 1000
        if number % 2:  # Goes before the answer.
            client.request("POST", "/frame", body, {"Content-Type": "application/json"})
        client.close()

    with Server(Viewer([ViewerScene(run, "run", None)]), port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        live(look, FRAMES // FRAMES_EACH, most=8)
        server.shutdown()
