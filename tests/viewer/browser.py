"""Chromium from the system, driven by Playwright; tests are skipped where either is absent."""

import os
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Software rendering, so that a test needs no GPU; Chromium as root has no sandbox.
ARGUMENTS = ["--enable-unsafe-swiftshader", *["--no-sandbox"] * (os.geteuid() == 0)]

# What Chromium says of a software GPU: its speed, and that it lost a context, after which pages draw again, as the
# tests see.
HARMLESS = ("gpu stall", "swiftshader", "losecontext: context lost")


@contextmanager
def browser():
    """A Chromium; contexts and pages are the caller's."""
    playwright = pytest.importorskip("playwright.sync_api")
    executable = next(filter(None, map(shutil.which, NAMES)), None)
    if executable is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as driver:
        chromium_browser = driver.chromium.launch(executable_path=executable, args=ARGUMENTS)
        yield chromium_browser
        chromium_browser.close()


@contextmanager
def page_of(chromium_browser, url, width=700, height=420, script="", **options):
    """A page that may reach nothing but its own server or file, and must not complain.

    script: runs before its own. options: of the browser's context, such as has_touch.
    """
    complaints = []
    viewport = {"width": width, "height": height}
    context = chromium_browser.new_context(viewport=viewport, accept_downloads=True, **options)
    context.add_init_script(script)
    page = context.new_page()
    page.on("console", lambda line: complaints.append(line.text) if line.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on(
        "request",
        lambda request: None if request.url.startswith((url, "blob:", "data:")) else complaints.append(request.url),
    )
    page.goto(url)
    yield page
    left = [line for line in complaints if not any(words in line.lower() for words in HARMLESS)]
    context.close()
    assert not left, f"the page complained: {left}"


def pinch(page, before, after):
    """Move two fingers from two places to two others, in pixels of the page."""
    touch = page.context.new_cdp_session(page)
    for kind, fingers in (("touchStart", before), ("touchMove", after), ("touchEnd", ())):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(fingers)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def pixels(page, selector):
    """Return the picture of a canvas, [H, W, 3] in [0, 1] at its own size, once the view has stopped moving."""
    import base64
    import io

    rested = "while (typeof light !== 'undefined' && light.coarse) await new Promise(done => setTimeout(done, 50));"
    data = page.locator(selector).evaluate(f"async canvas => {{ {rested} return canvas.toDataURL('image/png'); }}")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGB")) / 255
