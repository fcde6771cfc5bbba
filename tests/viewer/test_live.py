"""`train --view`: the result is that without a viewer, and pictures take their share."""

import http.client
import io
import json
import math
import re
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.images.ldr_files import quantize
from sehdr_warp.output.light_pictures import photo_for_display
from sehdr_warp.training.train import create_trainer, train
from sehdr_warp.viewer.live import SHARE, LiveTraining, serve_training

from ..training.toy import toy_scene
from .browser import browser

CONFIG = {"schedule.iterations": 60, "plan.enabled": False}


def ask(address, path, body=None):
    connection = http.client.HTTPConnection(address, timeout=30)
    headers = {"Content-Type": "application/json"}
    connection.request("GET" if body is None else "POST", path, body and json.dumps(body), headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_result_is_that_without_a_viewer(tmp_path, logged):
    scene = toy_scene()
    alone = train(scene, tmp_path / "alone", CONFIG, device="cpu")
    training, answers = create_trainer(scene, tmp_path / "seen", CONFIG, device="cpu"), []

    def look(address):
        camera = scene.views[0].camera.resized(48, 48).to_dict()
        while not done.is_set():
            status, content = ask(address, "/frame", {"camera": camera})
            status_json = json.loads(ask(address, "/training")[1])
            answers.append((status, np.frombuffer(content, "<f2") if status == 200 else content, status_json))

    done = threading.Event()
    with serve_training(training, "toy") as steps:
        address = re.search(r"http://([^/]*)/", logged[-1])[1]
        looking = threading.Thread(target=look, args=(address,))
        looking.start()
        ask(address, "/training", {"do": "pause"})
        for step in steps:
            if step.iteration == 2:  # Single steps, then on.
                assert json.loads(ask(address, "/training")[1])["paused"]
                ask(address, "/training", {"do": "resume"})
            elif step.iteration == 1:
                ask(address, "/training", {"do": "step"})
        done.set()
        looking.join()
    assert training.run.checkpoint_hash == alone.checkpoint_hash
    frames = [frame for status, frame, _ in answers if status == 200]
    assert len(frames) >= 2 and all(frame.size == 48 * 48 * 5 for frame in frames)
    assert np.abs(frames[-1][:100] - frames[0][:100]).max() > 0
    assert answers[-1][2]["iteration"] > 2 and len(answers[-1][2]["curve"]) >= 2
    assert ask_fails(address)


def ask_fails(address):
    try:
        ask(address, "/scene")
    except OSError:
        return True
    return False


def test_a_sensors_colors_are_shown_in_rec709_as_the_run_shows_them(tmp_path, logged):
    matrix = np.array([[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]])
    scene = replace(toy_scene(), color_matrix=matrix, light_known=True)
    training = create_trainer(scene, tmp_path / "raw", CONFIG | {"schedule.iterations": 3}, device="cpu")
    with serve_training(training, "raw") as steps:
        address = re.search(r"http://([^/]*)/", logged[-1])[1]
        for _ in steps:
            pass
        status, photo = ask(address, "/photo/0/1")
    camera, run = scene.views[1].camera, training.run
    rendered = training.render(camera).hdr.detach()
    np.testing.assert_allclose(rendered, run.render(camera).hdr, atol=1e-5)
    assert (rendered - run.field.render(camera, degree=run.degree).hdr).abs().max() > 0.1
    assert status == 200
    np.testing.assert_array_equal(Image.open(io.BytesIO(photo)), quantize(photo_for_display(run, scene.views[1])))


class Steps:
    """Stands for a training of even steps, each `seconds` long, whose pictures take `picture` seconds."""

    def __init__(self, count, seconds, picture):
        self.count, self.seconds, self.picture = count, seconds, picture
        self.ending, self.total = False, count
        self.keep_ranks_waiting = lambda: None
        self.loss, self.psnr, self.gaussians, self.seconds_left = 0.5, 20.0, 3, None

    def __iter__(self):
        for iteration in range(1, self.count + 1):
            if self.ending:
                return
            self.iteration = iteration
            time.sleep(self.seconds)
            yield self

    def render(self, camera):
        time.sleep(self.picture)
        return camera


@pytest.mark.parametrize("watched", [True, False])
def test_pictures_take_their_share_and_no_more(watched):
    live = LiveTraining(Steps(60, 0.01, 0.01), "even")

    def look():
        try:
            while True:
                live.render(None)
        except SehdrError as error:
            assert "has ended" in str(error)

    looking = threading.Thread(target=look)
    if watched:
        looking.start()
    started = time.perf_counter()
    assert sum(1 for _ in live.attend()) == 60
    share = live.picture_seconds / (time.perf_counter() - started)
    assert (0.02 < share < 1.6 * SHARE) if watched else share == 0
    if watched:
        looking.join(10)
    with pytest.raises(SehdrError, match="has ended"):
        live.render(None)


def test_the_page_can_read_figures_that_a_step_lacks():
    """A browser refuses NaN in JSON, and would take it for the end of the training."""
    steps = Steps(1, 0, 0)
    steps.psnr = math.nan
    live = LiveTraining(steps, "masked")
    assert len(list(live.attend())) == 1
    assert json.loads(json.dumps(live.progress(), allow_nan=False))["psnr"] is None


def test_an_interrupt_ends_a_pause_and_errors_reach_who_asked():
    steps = Steps(50, 0.001, 0)
    live = LiveTraining(steps, "paused")
    live.control("pause")
    threading.Timer(0.3, lambda: setattr(steps, "ending", True)).start()
    started = time.perf_counter()
    assert sum(1 for _ in live.attend()) == 1 and 0.2 < time.perf_counter() - started < 5
    steps = Steps(50, 0.005, 0)
    live, steps.render = LiveTraining(steps, "broken"), lambda camera: 1 / 0
    threading.Thread(target=lambda: list(live.attend()), daemon=True).start()
    with pytest.raises(ZeroDivisionError):
        live.render(None)
    with pytest.raises(ValueError, match="not one of pause"):
        live.control("explode")


def test_the_page_pauses_steps_and_says_the_end(tmp_path, logged):
    training = create_trainer(toy_scene(), tmp_path / "run", CONFIG | {"schedule.iterations": 150}, device="cpu")
    served, paused = threading.Event(), threading.Event()

    def work():
        with serve_training(training, "toy") as steps:
            served.set()
            for _ in steps:
                paused.wait(60)  # The first step's, or a training this short ends while the page opens.

    with browser() as chromium:
        page = chromium.new_page(viewport={"width": 440, "height": 300})
        threading.Thread(target=work).start()
        served.wait(60)
        page.goto(re.search(r"http://\S*", logged[-1])[0])

        def wait(text, place="#progress"):
            page.locator(place, has_text=re.compile(text)).wait_for()

        wait(" of 150 ")
        page.click("#pause")
        wait("Resume", "#pause")
        paused.set()
        page.wait_for_timeout(1100)  # It asks once a second.
        stopped = int(page.text_content("#progress").split()[0])
        page.wait_for_timeout(1100)
        assert page.text_content("#progress").startswith(f"{stopped} of 150 \N{MIDDLE DOT} loss 0.")
        for _ in range(2):
            page.click("#step")
        wait(f"^{stopped + 2} of")
        curves = "canvas => canvas.getContext('2d').getImageData(0, 0, 248, 70).data.some(value => value)"
        assert page.locator("#curves").evaluate(curves)
        page.click("#pause")
        page.locator("#pause:disabled").wait_for()
        wait("the training has ended", "#status")
        assert page.is_disabled("#step")


def test_a_picture_is_saved_while_a_scene_is_trained(tmp_path, logged):
    scene = toy_scene()
    training = create_trainer(scene, tmp_path / "run", CONFIG | {"schedule.iterations": 3}, device="cpu")
    camera, answers = scene.views[0].camera.resized(24, 24).to_dict(), []
    with serve_training(training, "toy") as steps:
        address = re.search(r"http://([^/]*)/", logged[-1])[1]
        body = {"cameras": [camera], "kind": "exr"}
        saving = threading.Thread(target=lambda: answers.append(ask(address, "/save", body)))
        ask(address, "/training", {"do": "pause"})
        saving.start()
        threading.Thread(target=lambda: (saving.join(), ask(address, "/training", {"do": "resume"}))).start()
        for _ in steps:
            pass
        saving.join()
    assert answers[0][0] == 200, answers[0][1]
    assert answers[0][1][:4] == b"v/1\x01"
