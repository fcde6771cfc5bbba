"""The viewer's server: a page, float frames, photos and files to save, for browsers on this machine unless told.

Nothing that comes in is trusted: a fixed set of paths, bounded bodies and sizes, and no other site's page may ask.
"""

import errno
import io
import json
import logging
import socket
import tempfile
import threading
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from PIL import Image

from ..errors import SehdrError
from ..output.camera_paths import interpolate
from ..output.film import write_film
from ..output.images import quantize
from ..output.light_pictures import page_file, shown_photo
from ..output.render_views import render_views
from .frames import ViewerScene, camera_file, camera_of

log = logging.getLogger(__name__)
PORTS_TRIED = 50
MOST_BODY, MOST_VIEWS, MOST_CONNECTIONS = 4 << 20, 2000, 100
PATIENCE = 60.0  # Seconds that a connection may be silent
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
    "frame-ancestors 'none'",
}
_LOCAL = ("127.0.0.1", "localhost", "[::1]")


class Refusal(Exception):
    """An error answer: an HTTP status and one line."""

    def __init__(self, status: int, line: str):
        """Set the status and the line."""
        self.status = status
        super().__init__(line)


class Viewer:
    """What the server shows, and its answers to a page."""

    def __init__(
        self, runs: Sequence[ViewerScene], photos: Callable[[int], dict[str, Any]] | None = None, training: Any = None
    ):
        """Set what is shown.

        Args:
            runs: Scenes to look at and compare.
            photos: Returns the views of a run by name, and reads them on first use; raises SehdrError if they are gone.
            training: A LiveTraining, if one runs.
        """
        self.runs, self.training, self.saving = list(runs), training, ""
        self._photos, self._reading, self._saving = photos, threading.Lock(), threading.Lock()
        page = Path(__file__).parent / "page"
        self.files = {
            "/": ("text/html", page.joinpath("viewer.html").read_text(encoding="utf-8")),
            "/viewer.css": (
                "text/css",
                page_file("style.css") + page.joinpath("viewer.css").read_text(encoding="utf-8"),
            ),
            **{f"/{name}": ("text/javascript", page_file(name)) for name in ("tables.js", "light.js", "camera.js")},
            "/viewer.js": ("text/javascript", page.joinpath("viewer.js").read_text(encoding="utf-8")),
        }

    def get(self, path: str) -> tuple[str, bytes]:
        """Answer a GET: content type and content; raise Refusal."""
        if path in self.files:
            kind, text = self.files[path]
            return f"{kind}; charset=utf-8", text.encode()
        if path == "/scene":
            facts = {"runs": [run.facts() for run in self.runs], "training": self.training is not None}
            return "application/json", json.dumps(facts).encode()
        if path == "/versions":
            return "application/json", json.dumps([run.version for run in self.runs]).encode()
        if path == "/training" and self.training is not None:
            return "application/json", json.dumps(self.training.progress()).encode()
        if path == "/saving":
            return "text/plain", self.saving.encode()
        if path.startswith("/photo/"):
            return "image/png", self._photo(path.removeprefix("/photo/"))
        raise Refusal(404, "no such page")

    def post(self, path: str, request: dict) -> tuple[str, bytes | memoryview]:
        """Answer a POST: content type and content; raise Refusal, or the error of a bad request."""
        if path == "/training" and self.training is not None:
            self.training.control(str(request["do"]))
            return "application/json", b"{}"
        if path == "/frame":
            options = {name: bool(request.get(name)) for name in ("draft", "clipped")}
            return "application/octet-stream", self._run(request).frame(camera_of(request["camera"]), **options)
        if path in ("/path", "/save"):
            cameras = [camera_of(camera) for camera in request["cameras"][:MOST_VIEWS]]
            if not cameras:
                raise Refusal(400, "the request has no cameras")
            if request.get("count"):
                cameras = interpolate(cameras, min(int(request["count"]), MOST_VIEWS))
            if path == "/path":
                return "application/json", camera_file(cameras).encode()
            return self._save(self._run(request), cameras, str(request["kind"]), request)
        raise Refusal(404, "no such page")

    def _run(self, request: dict) -> ViewerScene:
        index = int(request.get("run", 0))
        if not 0 <= index < len(self.runs):
            raise Refusal(404, "no such run")
        return self.runs[index]

    def _photo(self, name: str) -> bytes:
        """Return the photo of a run and view, named by their indices, as PNG."""
        run, _, view = name.partition("/")
        if not (run.isascii() and view.isascii() and run.isdigit() and view.isdigit() and len(name) < 20):
            raise Refusal(404, "no such photo")
        entries = self._run({"run": run}).cameras
        if self._photos is None or int(view) >= len(entries):
            raise Refusal(404, "no such photo")
        with self._reading:
            view_photo = self._photos(int(run)).get(entries[int(view)].name)
        if view_photo is None:
            raise Refusal(404, "no such photo")
        buffer = io.BytesIO()
        photo = shown_photo(self._run({"run": run}), view_photo)
        Image.fromarray(quantize(photo)).save(buffer, "PNG", compress_level=1)
        return buffer.getvalue()

    def _save(self, run: ViewerScene, cameras: Sequence, kind: str, request: dict) -> tuple[str, bytes]:
        """Return files of cameras as `render` writes them: one EXR, a zip of brackets and the rest, or a film."""
        if not self._saving.acquire(blocking=False):
            raise Refusal(503, "another save is still being made")
        try:
            with tempfile.TemporaryDirectory() as folder:
                if kind == "film":
                    stops = float(request.get("stops") or 0)
                    options = {"ev_ramp": (stops, stops), "exposed": True, "tell": self._tell}
                    return "video/mp4", write_film(run, Path(folder, "film.mp4"), cameras, **options).read_bytes()
                camera_path = Path(folder, "cameras.json")
                camera_path.write_text(camera_file(cameras), encoding="utf-8")
                evs = str(request.get("evs") or "-4,-2,0,2,4") if kind == "brackets" else None
                files = render_views(run, Path(folder, "views"), cameras=camera_path, evs=evs)
                if kind == "exr" and len(cameras) == 1:
                    return "image/x-exr", files[0].read_bytes()
                buffer = io.BytesIO()
                with zipfile.ZipFile(buffer, "w") as packed:
                    for file in files:
                        packed.write(file, file.relative_to(folder))
                return "application/zip", buffer.getvalue()
        finally:
            self.saving = ""
            self._saving.release()

    def _tell(self, line: str) -> None:
        """Set the line that a page shows while a film is rendered."""
        self.saving = line


class Server(ThreadingHTTPServer):
    """The viewer's server on a port of a host; `url` is its address."""

    daemon_threads, block_on_close, request_queue_size = True, False, 64

    def __init__(self, viewer: Viewer, host: str = "127.0.0.1", port: int = 8080):
        """Listen on the port, or on the next free one."""
        self.viewer, self.host = viewer, host
        self.free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        for tried in range(port, min(port + PORTS_TRIED, 65536)):
            try:
                super().__init__((host, tried), _Handler)
                break
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise SehdrError(
                        f"{host}:{tried}: cannot be served from ({error.strerror}); choose another"
                    ) from None
                log.info("port %d is in use", tried)
        else:
            raise SehdrError(f"--port {port}: no port from there on is free; choose another")
        place = f"[{host}]" if ":" in host else host
        self.url = f"http://{place}:{self.server_address[1]}/"

    def process_request(self, request, client_address) -> None:
        """Start a thread for a connection, unless there are too many."""
        if not self.free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request, client_address) -> None:
        """Serve a connection and release its place."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.free.release()

    def handle_error(self, request, client_address) -> None:
        """Log a broken connection for debugging only."""
        log.debug("a connection of %s ended", client_address)

    def allowed(self, host: str, origin: str | None) -> bool:
        """Whether a request comes from a page of this server: another site's could reach it by a name of its own."""
        name, _, port = host.rpartition(":") if not host.endswith("]") else (host, "", "")
        name = name or port
        local = self.host in ("127.0.0.1", "localhost", "::1")
        return (not local or name in _LOCAL) and origin in (None, f"http://{host}")


class _Handler(BaseHTTPRequestHandler):
    protocol_version, timeout, disable_nagle_algorithm = "HTTP/1.1", PATIENCE, True
    error_message_format, error_content_type = "%(message)s", "text/plain"
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        self._answer(lambda path: self.server.viewer.get(path))

    def do_POST(self) -> None:
        self._answer(lambda path: self.server.viewer.post(path, self._body()))

    def _body(self) -> dict:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and int(length) <= MOST_BODY):
            self.close_connection = True
            raise Refusal(413, f"a request says its length, of at most {MOST_BODY} bytes")
        data = self.rfile.read(int(length))
        if self.headers.get_content_type() != "application/json":
            raise Refusal(415, "a request is JSON")
        values = json.loads(data)
        if not isinstance(values, dict):
            raise Refusal(400, "a request is an object")
        return values

    def _answer(self, find: Callable[[str], tuple[str, bytes | memoryview]]) -> None:
        try:
            if not self.server.allowed(self.headers.get("Host", ""), self.headers.get("Origin")):
                self.close_connection = True
                raise Refusal(403, "only pages of this server may ask")
            status, (kind, content) = 200, find(self.path)
        except Refusal as error:
            status, kind, content = error.status, "text/plain", str(error).encode()
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            status, kind, content = 400, "text/plain", f"cannot be used: {error!s:.200}".encode()
        except (RuntimeError, MemoryError) as error:  # A GPU without room
            status, kind, content = (
                500,
                "text/plain",
                f"cannot be rendered: {' '.join(str(error).split())[:200]}".encode(),
            )
        except SehdrError as error:
            status, kind, content = 409, "text/plain", str(error).encode()
        except OSError:  # The browser has gone.
            self.close_connection = True
            return
        with suppress(OSError):
            self.send_response(status)
            for name, value in {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

    def log_message(self, format: str, *args) -> None:
        log.debug(format, *args)
