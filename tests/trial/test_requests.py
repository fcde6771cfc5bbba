"""What strangers ask a viewer, and a viewer among many who never read, never ask or never end to."""

import json
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from sehdr_warp.runs.run import load_run
from sehdr_warp.viewer.server import Server, Viewer
from sehdr_warp.viewer.viewer_scene import ViewerScene

from .harness import files_in
from .hostile import CAMERA

pytestmark = pytest.mark.trial


@pytest.fixture(scope="module")
def served(prepared):
    """A viewer of the run, for all requests of this file: each leaves it as it was."""
    run = load_run(prepared / "run")
    with Server(Viewer([ViewerScene(run, "run", run.clipped_share())]), port=0) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        server.camera = run.cameras[0].camera.to_dict()
        yield server
        server.shutdown()


def answer_to(port: int, data: bytes, seconds: float = 20.0, ends: bool = False) -> bytes:
    """What a server says to bytes, until it has said its length or closes. ends: the client says no more, of which the
    server takes it that it has gone."""
    said, length = bytearray(), None
    with socket.create_connection(("127.0.0.1", port), timeout=seconds) as client:
        try:
            client.sendall(data)
            if ends:
                client.shutdown(socket.SHUT_WR)
            while part := client.recv(1 << 16):
                said += part
                if length is None and (end := said.find(b"\r\n\r\n")) >= 0:
                    content_length = re.search(rb"Content-Length: (\d+)", said[:end])
                    length = end + 4 + int(content_length[1]) if content_length else math.inf
                if length is not None and len(said) >= length:
                    break
        except OSError:  # The server has closed it.
            pass
    return bytes(said)


def posted(path: str, body, host="localhost", **headers) -> bytes:
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    lines = {"Host": host, "Content-Type": "application/json", "Content-Length": len(data)} | headers
    head = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in lines.items())
    return f"POST {path} HTTP/1.1\r\n{head}\r\n".encode("latin-1") + data


def got(path: str, host="localhost", method="GET", version="HTTP/1.1", more="") -> bytes:
    return f"{method} {path} {version}\r\nHost: {host}\r\n{more}\r\n".encode("latin-1")


DEEP = b'{"camera": ' + b"[" * 200_000 + b"]" * 200_000 + b"}"
VIEW = json.dumps(CAMERA).encode()
REFUSED = {
    "path above": got("/../run/config.json"),
    "path of a disk": got("//etc/passwd"),
    "url": got("http://169.254.169.254/latest"),
    "photo of 10^18": got("/photo/0/1000000000000000000"),
    "photo above": got("/photo/../../run/config.json"),
    "photo of a digit of others": got("/photo/²/0"),
    "other host": got("/scene", host="evil.example"),
    "host in front": got("/scene", host="127.0.0.1.evil.example"),
    "host with a user": got("/scene", host="localhost@evil.example"),
    "no host": b"GET /scene HTTP/1.1\r\n\r\n",
    "origin null": got("/scene", more="Origin: null\r\n"),
    "origin of others": got("/scene", more="Origin: http://evil.example\r\n"),
    "put": got("/scene", method="PUT"),
    "connect": got("127.0.0.1:22", method="CONNECT"),
    "method of 60 KB": b"G" * 60_000 + b" / HTTP/1.1\r\n\r\n",
    "version 9": got("/scene", version="HTTP/9.9"),
    "line without an end": b"GET /" + b"a" * 100_000,
    "headers of 10,000": got("/scene", more="X: y\r\n" * 10_000),
    "header of 100 KB": got("/scene", more="X: " + "y" * 100_000 + "\r\n"),
    "zeros": b"\0" * 5000,
    "tls": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\xff" * 500,
    "no length": b"POST /frame HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n\r\n{}",
    "length below 0": posted("/frame", {}, Content_Length=-1),
    "length of 10^18": posted("/frame", {}, Content_Length=10**18),
    "length of 5,000 digits": posted("/frame", {}, Content_Length="9" * 5000),
    "length of words": posted("/frame", {}, Content_Length="many"),
    "length of other digits": posted("/frame", {}, Content_Length="²"),
    "chunks": posted("/frame", {}, Content_Length="", Transfer_Encoding="chunked"),
    "deep": posted("/frame", DEEP),
    "nan": posted("/frame", b'{"camera": NaN}'),
    "a text for a camera": posted("/frame", {"camera": "x"}),
    "run of 10^18": posted("/frame", {"camera": {}, "run": 10**18}),
    "run of a list": posted("/frame", {"camera": {}, "run": [0]}),
    "not utf-8": posted("/frame", b'{"camera": "\xff\xfe"}'),
    "a surrogate": posted("/frame", b'{"camera": "\\ud800"}'),
    "other path": posted("/scene", {}),
    "run of 1e400": posted("/frame", b'{"camera": %s, "run": 1e400}' % VIEW),
    "count of 1e400": posted("/path", b'{"cameras": [%s], "count": 1e400}' % VIEW),
    "count of 5,000 digits": posted("/path", b'{"cameras": [%s], "count": %s}' % (VIEW, b"9" * 5000)),
    "page of a run that is none": posted("/save", b'{"kind": "page", "run": 7, "cameras": [%s]}' % VIEW),
    "light of 1e400": posted("/gain", b'{"light": 1e400, "stops": 1}'),
    "gain of 1e400": posted("/gain", b'{"light": 0, "stops": 1e400}'),
    "gain of a text": posted("/gain", b'{"light": 0, "stops": "nan"}'),
    "up of zeros": posted("/orientation", {"up": [0, 0, 0]}),
    "up of 1e400": posted("/orientation", b'{"up": [1e400, 0, 0]}'),
    "up of many": posted("/orientation", {"up": [1] * 100_000}),
    "scale of 1e-320": posted("/orientation", {"scale": 1e-320}),
    "crop of a text": posted("/edit", {"crop": "9," * 50_000}),
}


@pytest.mark.parametrize("name", REFUSED)
def test_requests_that_are_refused(served, name):
    said = answer_to(served.server_address[1], REFUSED[name], ends=True)
    status = re.match(rb"HTTP/1\.1 (\d{3})", said)
    assert said == b"" or said[:5] != b"HTTP/" or 400 <= int(status[1]) <= 505, said[:300]
    assert b"Traceback" not in said and b"root:" not in said and len(said) < 3000
    assert answer_to(served.server_address[1], got("/versions")).startswith(b"HTTP/1.1 200")


CAMERAS = {
    "2^31 wide": {"width": 2**31},
    "below 0": {"height": -1},
    "a million wide": {"width": 1 << 20, "height": 9},
    "1e308": {"fx": 1e308},
    "focal 0": {"fy": 0},
    "text": {"cx": "x"},
    "pose of 1e300": {"world_to_camera": [[1e300] * 4] * 4},
    "pose of text": {"world_to_camera": "x" * 16},
    "no pose": {"world_to_camera": []},
    "projection": {"projection": "../x"},
    "sphere": {"projection": "equirectangular", "width": 9, "height": 9},
    "lens": {"projection": "OPENCV_FISHEYE", "distortion": [1e300] * 4},
    "lens of many": {"projection": "OPENCV_FISHEYE", "distortion": [0.0] * 100_000},
}


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("path", ["/frame", "/save"])
def test_cameras_that_are_asked_for(served, path, name):
    camera = served.camera | CAMERAS[name]
    payload = {"camera": camera} if path == "/frame" else {"cameras": [camera], "kind": "exr"}
    said = answer_to(served.server_address[1], posted(path, payload), 60)
    assert re.match(rb"HTTP/1\.1 (200|400|413|500)", said) and b"Traceback" not in said


SAVES = {
    "kind of a path": {"kind": "../../x"},
    "kind of 1 MB": {"kind": "x" * 1_000_000},
    "stops": {"kind": "film", "stops": 1e308},
    "exposures of words": {"kind": "brackets", "evs": "x,y"},
    "exposures of many": {"kind": "brackets", "evs": ",".join(["1"] * 100_000)},
    "exposures of 1e308": {"kind": "brackets", "evs": "1e308,-1e308"},
    "a path of 10^18": {"kind": "exr", "count": 10**18},
    "no cameras": {"kind": "exr", "cameras": []},
    "cameras of a text": {"kind": "exr", "cameras": "xx"},
    "cameras of a number": {"kind": "exr", "cameras": 5},
    "edits": {"kind": "exr", "edits": {"crop": ["x"] * 99}},
}


@pytest.mark.parametrize("name", SAVES)
def test_saves_that_are_asked_for(served, name, tmp_path, monkeypatch):
    import tempfile

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("sehdr_warp.viewer.clients.MOST_VIEWS", 300)  # Many as well, and soon saved.
    camera = served.camera | {"width": 8, "height": 8}
    said = answer_to(served.server_address[1], posted("/save", {"cameras": [camera]} | SAVES[name]), 60)
    assert re.match(rb"HTTP/1\.1 (200|4\d\d|5\d\d)", said) and b"Traceback" not in said and not files_in(tmp_path)


def of_process(number: int) -> tuple[float, float]:
    """Resident MiB of a process now, and at most."""
    text = Path(f"/proc/{number}/status").read_text()
    return tuple(int(re.search(rf"{name}:\s+(\d+)", text)[1]) / 1024 for name in ("VmRSS", "VmHWM"))


def begin(port: int, text: bytes) -> socket.socket:
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.settimeout(10)
    client.connect(("127.0.0.1", port))
    client.sendall(text)
    client.setblocking(False)
    return client


def ended(client: socket.socket) -> bool:
    """Whether the server has closed a connection of which nobody reads."""
    poll = select.poll()
    poll.register(client, select.POLLRDHUP | select.POLLHUP | select.POLLERR)
    return bool(poll.poll(0))


SILENT = (b"", b"GET /sce", b"POST /frame HTTP/1.1\r\nHost: localhost\r\n",
          posted("/frame", b"{", Content_Length=3_000_000))  # fmt: skip


def test_a_viewer_among_silent_and_deaf_clients(prepared, record_property):
    """100 silent clients, 16 that ask for large frames and never read, each anew some time after it is closed, and one
    that behaves. SEHDR_TRIAL_SECONDS: how long, 20 by default."""
    lasts = float(os.environ.get("SEHDR_TRIAL_SECONDS", "20"))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    environment.pop("SEHDR_THREADS", None)
    command = [sys.executable, "-m", "sehdr_warp", "view", "run", "--port", "0", "--device", "cpu"]
    viewer = subprocess.Popen(command, cwd=prepared, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        port = int(re.search(rb":(\d+)/", viewer.stdout.readline())[1])
        camera = json.loads(answer_to(port, got("/scene")).partition(b"\r\n\r\n")[2])["runs"][0]
        camera = camera.get("cameras", camera.get("views"))[0]
        camera = camera.get("camera", camera)
        scale = 1600 / camera["width"]
        large = {name: camera[name] * scale for name in ("fx", "fy", "cx", "cy")} | {"width": 1600, "height": 1200}
        payload = posted("/frame", {"camera": camera | large, "clipped": True})
        texts = [*[payload] * 16, *[SILENT[number % len(SILENT)] for number in range(100)]]
        clients, waits, largest, end = [begin(port, text) for text in texts], [], 0.0, time.monotonic() + lasts
        back = dict.fromkeys(range(len(texts)), 0.0)
        while time.monotonic() < end:
            for request, least in ((got("/versions"), 20), (posted("/frame", {"camera": camera}), 1000)):
                started = time.monotonic()
                said = answer_to(port, request, 60)
                waits.append(time.monotonic() - started)
                assert said.startswith(b"HTTP/1.1 200") and len(said) > least, said[:200]
            largest = max(largest, of_process(viewer.pid)[1])
            for number, client in enumerate(clients):
                if client is not None and ended(client):
                    client.close()
                    clients[number], back[number] = None, time.monotonic() + lasts / 10
                elif client is None and time.monotonic() > back[number]:
                    clients[number] = begin(port, texts[number])
            time.sleep(0.3)
        for client in filter(None, clients):
            client.close()
    finally:
        viewer.send_signal(signal.SIGTERM)
        output = viewer.communicate(timeout=60)[1].decode()
    waits.sort()
    record_property("memory", f"up to {largest:.0f}")
    parts = ", ".join(f"{share} %: {waits[len(waits) * share // 100]:.3f} s" for share in (50, 95, 99))
    print(f"{lasts:.0f} s, {len(waits)} requests: {parts}, longest {waits[-1]:.3f} s, "
          f"{largest:.0f} MiB at most")  # fmt: skip
    assert "Traceback" not in output and largest < 600
    assert waits[len(waits) * 99 // 100] < 1, waits[-9:]
