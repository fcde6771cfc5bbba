"""report.html as strangers meet it: valid, alone, small, and with the light that it says it has."""

import base64
import hashlib
import html
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.output.images.display import display_gain
from sehdr_warp.output.notebook import run_html
from sehdr_warp.output.report.write import write_report
from sehdr_warp.output.world_transform import world_transform

from ...viewer.browser import browser, page_of
from ..helpers import LIGHTS, AnalyticRun, make, validate

pytestmark = pytest.mark.usefixtures("coarse_figures")
PLAN = [{"name": "brackets", "choice": "plain <scaling>", "reason": "0.0% of the pixels clip"}]
FIGURES = {"psnr": 31.4, "ssim": 0.9}, {"psnr_mu": 28.2, "ssim_mu": None}
EVALUATION = {
    "views": [{"name": "v_1", "ldr": FIGURES[0], "protocol": {"gt-max": FIGURES[1]}}],
    "ldr": FIGURES[0],
    "protocol": {"gt-max": FIGURES[1]},
    "regions": {"clipped": {"fraction": 0.25, "psnr_ldr": 20.0, "psnr_mu": {"gt-max": None}}},
}


REGION = {"column": 1.0, "row": 7.0, "pixels": 9, "stops": 1.25, "box": [0, 6, 3, 3]}


def page(tmp_path, *, unexplained=True, **options):
    run, scene = make(tmp_path, **options)
    named = {"photo": "v_0", "column": 5.0, "row": 7.0, "pixels": 9, "stops": 1.25}
    worst = [named | {"box": [4, 6, 3, 3]}, named | {"stops": -2.0, "box": [5, 7, 1, 1]}]
    run.summary = lambda: {"unexplained": {"regions": 2, "photos": 1, "worst": worst}} if unexplained else {}
    run.decisions = lambda: PLAN
    return write_report(run, scene, tmp_path / "report", evaluation=EVALUATION)[0].read_text()


def headings(text):
    return re.findall(r"<h2>(.*?)</h2>", text)


def test_the_page_is_valid_alone_and_complete(tmp_path):
    text = page(tmp_path)
    validate(text)
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:)""", text) and "url(" not in text
    assert len(text) < 5e6
    expected = ["Light above white", "Photo, scene, truth", "Brackets", "Confidence", "What stays unexplained"]
    assert headings(text) == [*expected, "What was decided, and why", "Figures", "PSNR over time", "Cameras"]
    assert "<li>a note of <code>the training</code></li>" in text
    assert text.index("<h2>Light above white") < text.index('class="facts"') < text.index("<h2>Photo, scene, truth")
    for checked in ("plain &lt;scaling&gt;", "31.40", "25.0%", "26.0 dB", "65 s", "+1.2<", "\N{MINUS SIGN}2<"):
        assert checked in text
    assert '<rect x="3.8" y="5.8"' in text  # Around the box, by three units of a 32-pixel photo


def test_photos_of_several_sizes_are_so_called_and_letters_at_the_border_are_whole(tmp_path):
    run, scene = make(tmp_path)
    view = scene.views[0]
    height, width = view.codes.shape[:2]
    assert f"pixels each<b>{width} \N{MULTIPLICATION SIGN} {height}<" in page(tmp_path / "one")
    small = replace(view, camera=view.camera.resized(8, 6), codes=view.codes[:6, :8], hdr=None)
    run.summary = lambda: {"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"photo": "v_1"}]}}
    scene = replace(scene, views=(small, *scene.views[1:]))
    text = write_report(run, scene, tmp_path / "two", evaluation=EVALUATION)[0].read_text()
    assert f"pixels at most<b>{width} \N{MULTIPLICATION SIGN} {height}<" in text
    box, letters = re.search(
        r'<rect x="(.*?)" .*?<text x="(.*?)"', text[text.index("unexplained regions of") :]
    ).groups()
    assert float(box) < 0 < float(letters)


def test_lights_are_listed_with_what_is_certain_of_them(tmp_path, monkeypatch):
    bright = replace(LIGHTS[0], radiance=np.multiply(LIGHTS[0].radiance, 1000))
    lights = [bright, LIGHTS[1], *LIGHTS * 5, LIGHTS[0], replace(LIGHTS[1], deviation=3.0)]
    monkeypatch.setattr(AnalyticRun, "clipped_share", lambda self: True)
    monkeypatch.setattr(AnalyticRun, "find_lights", lambda self: lights, raising=False)
    text = page(tmp_path)
    validate(text)
    position = world_transform(make(tmp_path)[0]).points(LIGHTS[0].shape.position)
    place = ",\N{NO-BREAK SPACE}".join(f"{value:.3g}" for value in position)
    assert "Lights" in headings(text) and "12 of 14: the largest shares." in text
    cells = re.findall(r"<td[^>]*>(.*?)</td>", text[text.index("<h2>Lights") : text.index("<h2>Confidence")])
    assert len(cells) == 12 * 8
    assert [cell.replace("\N{NARROW NO-BREAK SPACE}", " ") for cell in cells[:8]] == [
        *("light_0", "rect", "0.4 \N{MULTIPLICATION SIGN} 0.2", place),
        *("50.0%", "4 670", "1", "0.4"),
    ]
    assert cells[8:10] == ["light_1", "sphere"] and cells[15] == "\N{EN DASH}"
    assert "uncertain by" not in text  # The last one is, and is not in the table.


def test_a_light_that_photos_walk_around_is_listed(tmp_path, monkeypatch):
    """It has no share of the light around what the photos look at, and so comes last."""
    lights = [*LIGHTS * 7, replace(LIGHTS[1], share=0.0, deviation=3.0)]
    monkeypatch.setattr(AnalyticRun, "clipped_share", lambda self: True)
    monkeypatch.setattr(AnalyticRun, "find_lights", lambda self: lights, raising=False)
    text = page(tmp_path)
    names = re.findall(r">(light_\d+)<", text[text.index("<h2>Lights") : text.index("<h2>Confidence")])
    assert names == [f"light_{index}" for index in (*range(11), 14)]
    assert "12 of 15: the largest shares, and lights that photos walk around. light_14: uncertain by" in text


def test_what_is_not_known_is_left_out(tmp_path):
    text = page(tmp_path, truth=False, splits=("train", "train"), metrics=None, unexplained=False)
    assert "What stays unexplained" not in headings(text) and "PSNR over time" not in headings(text)
    assert "none is held out" in text and 'data-name="Truth"' not in text
    assert "--out views --cameras train --evs" in text
    assert headings(text)[1] == "Photo and scene" and "Scene and truth" not in text


def test_the_pictures_keep_the_light_and_look_like_photos(tmp_path):
    imagecodecs = pytest.importorskip("imagecodecs")
    run, scene = make(tmp_path)
    thumbnail = re.search(r'src="data:image/jpeg;base64,([^"]*)" alt="Scene of v_1"', page(tmp_path))
    decoded = imagecodecs.ultrahdr_decode(base64.b64decode(thumbnail[1])).astype(np.float64)[..., :3]
    exposure = run.render(scene.views[1].camera).hdr.numpy() * 0.5
    light = exposure * display_gain(run.response)
    inside = light < 16
    assert inside.any() and np.median(decoded[inside] / light[inside]) == pytest.approx(1, abs=0.02)
    plain = np.asarray(Image.open(io.BytesIO(base64.b64decode(thumbnail[1])))) / 255
    np.testing.assert_allclose(plain.mean((0, 1)), run.response.encode(exposure).clip(0, 1).mean((0, 1)), atol=0.01)


EVIL = """</script><script>window.PWNED=1</script><img src=x onerror="window.PWNED=1">'"&"""


def evil_report(tmp_path):
    """A report in which all that a run and its photos say is markup."""
    run, scene = make(tmp_path)
    run.response = SimpleNamespace(name=EVIL, encode=run.response.encode, decode=run.response.decode)
    run.path, run.scene_name = EVIL, EVIL
    for entry in run.cameras:
        entry.name += EVIL
    views = tuple(replace(view, name=f"{view.name}{EVIL}") for view in scene.views)
    scene = replace(scene, name=EVIL, notes=(EVIL,), views=views)
    region = {"photo": views[0].name, "column": 5.0, "row": 7.0, "pixels": 9, "stops": 1.25, "box": [4, 6, 3, 3]}
    unexplained = {"regions": EVIL, "photos": EVIL, "worst": [region]}
    run.summary = lambda: {"device": EVIL, "unexplained": unexplained}
    run.notes = lambda: [EVIL + EVIL]
    run.decisions = lambda: [{"name": EVIL, "choice": EVIL, "reason": EVIL}]
    evaluation = EVALUATION | {
        "views": [EVALUATION["views"][0] | {"name": EVIL}],
        "regions": {EVIL: EVALUATION["regions"]["clipped"]},
    }
    return run, write_report(run, scene, tmp_path / "report", evaluation=evaluation)[0]


class _Elements(HTMLParser):
    """The scripts of a page, and every attribute that is not one of ours."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self.handlers, self.sources = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.handlers += [name for name in attributes if name.startswith("on")]
        self.sources += [attributes[name] for name in ("src", "href") if name in attributes]
        if tag == "script" and attributes.get("type", "text/javascript") == "text/javascript":
            self.scripts.append("")

    def handle_data(self, data):
        if self.lasttag == "script" and self.scripts and not self.scripts[-1]:
            self.scripts[-1] = data


def test_what_a_run_says_is_text_and_only_our_scripts_have_leave(tmp_path):
    run, path = evil_report(tmp_path)
    notebook = html.unescape(re.search(r'srcdoc="([^"]*)"', run_html(run))[1])
    for text in (path.read_text(), notebook):
        elements = _Elements(text)
        assert not elements.handlers and len(elements.scripts) == 1
        assert all(source.startswith("data:image/") for source in elements.sources)
        digest = base64.b64encode(hashlib.sha256(elements.scripts[0].encode()).digest()).decode()
        policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
        assert f"script-src 'sha256-{digest}';" in policy and policy.startswith("default-src 'none';")
        assert "unsafe-inline" not in policy.replace("style-src 'unsafe-inline'", "")
    assert path.read_text().count("PWNED") > 20


def test_browsers_run_our_script_and_no_other(tmp_path):
    _, path = evil_report(tmp_path)
    text = path.read_text()
    forced = tmp_path / "forced.html"  # As if one had come through all the same.
    forced.write_text(text.replace("</main>", "<script>window.PWNED=1</script><img src=x onerror='PWNED=1'></main>"))
    with browser() as chromium:
        for file in (path, forced):
            page = chromium.new_page()
            page.goto(file.as_uri())
            page.wait_for_timeout(500)
            assert page.evaluate("typeof window.PWNED") == "undefined"
            assert page.evaluate("typeof startDial") == "function"
            assert page.evaluate("document.querySelectorAll('.dial canvas').length") == 1
            page.close()


def test_a_phone_sees_the_whole_chart_and_all_brackets(tmp_path):
    (tmp_path / "report.html").write_text(page(tmp_path))
    with browser() as chromium, page_of(chromium, (tmp_path / "report.html").as_uri(), width=390) as phone:
        for content in (".diagram text", ".strip img"):
            ends = phone.locator(content).evaluate_all("all => all.map(each => each.getBoundingClientRect().right)")
            assert ends and max(ends) <= 390, content
