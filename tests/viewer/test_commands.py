"""`sehdr-warp view`."""

import http.client
import json
import os
import signal
import subprocess
import sys

import pytest

from sehdr_warp.cli import parse_command
from sehdr_warp.errors import UsageError
from sehdr_warp.training.train import train

from ..training.toy import toy_scene


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")
def test_the_command_serves_and_ends_cleanly(tmp_path):
    train(toy_scene(), tmp_path / "run", {"schedule.iterations": 5, "plan.enabled": False}, device="cpu")
    # Tests that run in a shell's background have SIGINT ignored, and children inherit that.
    code = "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "runpy.run_module('sehdr_warp', run_name='__main__', alter_sys=True)"
    command = [sys.executable, "-c", code, "view", str(tmp_path / "run"), "--port", "18300", "--device", "cpu"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    url = process.stdout.readline().split()[0]
    connection = http.client.HTTPConnection(url.removeprefix("http://").strip("/"), timeout=30)
    connection.request("GET", "/scene")
    assert json.loads(connection.getresponse().read())["runs"][0]["iterations"] == 5
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0 and not output and "Traceback" not in errors and "ended" in errors


def test_origins_are_checked(tmp_path):
    run, args = parse_command(["view", str(tmp_path), "--origin", "splats.example.org/x"])
    with pytest.raises(UsageError, match="write it as https://NAME"):
        run(args)
    assert (
        json.dumps(parse_command(["view", "r", "--origin", "https://a.example"])[1].origin) == '["https://a.example"]'
    )
