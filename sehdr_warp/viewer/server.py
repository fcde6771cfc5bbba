"""The viewer's server: a page, float frames, photos and files to save, for browsers on this machine by default.

Nothing that comes in is trusted: a fixed set of paths, bounded bodies and sizes, and no other site's page may ask.
"""

import errno
import io
import json
import logging
import re
import socket
import tempfile
import threading
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast

from PIL import Image

from ..errors import SehdrError
from ..json_values import damage, json_list, number
from ..output.film import write_film
from ..output.html import page_file
from ..output.images.ldr_files import quantize
from ..output.light_pictures import photo_for_display
from ..output.render_views import render_views
from ..output.scene_page import write_scene_page
from .clients import ClientRun, Refusal, cameras_of, choice, index_of, is_local, own_path
from .connections import SILENCE, BusyError, ClientGone, Connection, Connections
from .edits import edits_of, history_of, orient
from .renderer import Renderer
from .viewer_scene import ViewerScene, camera_file, camera_of, frame_bytes

log = logging.getLogger(__name__)
PORTS_TRIED = 50
MOST_BODY = 4 << 20
MOST_SAVED = 500_000_000  # Pixels of all pictures of a save, about 3 GB; `render` has no such bound
MOST_STOPS = 30.0
_SAVE_END = 30.0  # Seconds that the end of the server waits for a save to notice it
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_POLICY = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:"
_LOCAL = ("127.0.0.1", "localhost", "[::1]")
Answer = tuple[str, bytes | memoryview]  # Content type and content


class Viewer:
    """Runs that the server shows, and its answers to a page."""

    def __init__(
        self,
        runs: Sequence[ViewerScene],
        photos: Callable[[int], dict[str, Any]] = lambda index: {},
        training: Any = None,
    ):
        """Set what is shown.

        photos: returns the views of a run by name, and reads them on first use; raises SehdrError if they are gone.
        training: a LiveTraining, if one runs.
        """
        self.runs, self.training, self.save_line = list(runs), training, ""
        self._photos, self._photo_lock, self._save_lock = photos, threading.Lock(), threading.Lock()
        self._renderer = Renderer(second_thread=training is None and all(run.on_cpu for run in self.runs))
        self._closed = threading.Event()
        self._posts = {"/frame": self._frame, "/path": self._path, "/save": self._save}
        changes = {"/edit": self._edit, "/orientation": self._orient, "/lights": self._lights, "/gain": self._set_gain}
        self._posts |= changes if training is None else {"/training": self._control}
        page = Path(__file__).parent / "page"
        html, css, script = (
            page.joinpath(f"viewer.{kind}").read_text(encoding="utf-8") for kind in ("html", "css", "js")
        )
        scripts = {name: page_file(name) for name in ("tables.js", "light.js", "camera.js")} | {"viewer.js": script}
        self.files = {"/": ("text/html", html), "/viewer.css": ("text/css", page_file("style.css") + css)}
        self.files |= {f"/{name}": ("text/javascript", text) for name, text in scripts.items()}

    def get(self, path: str, client: Connection) -> Answer:
        """Answer a GET; raise Refusal."""
        if path in self.files:
            kind, text = self.files[path]
            return f"{kind}; charset=utf-8", text.encode()
        if path == "/scene":
            return _json({"runs": [run.facts() for run in self.runs], "training": self.training is not None})
        if path == "/versions":
            return _json([run.version for run in self.runs])
        if path == "/training" and self.training is not None:
            return _json(self.training.progress())
        if path == "/saving":
            return "text/plain", self.save_line.encode()
        if path.startswith("/photo/"):
            return "image/png", self._photo(path.removeprefix("/photo/"), client)
        raise Refusal(404, "no such page")

    def post(self, path: str, request: dict, client: Connection) -> Answer:
        """Answer a POST; raise Refusal, or the error of a bad request."""
        if path not in self._posts:
            raise Refusal(404, "no such page")
        return self._posts[path](request, client)

    def _control(self, request: dict, client: Connection) -> Answer:
        return _json(self.training.control(str(request["do"])) or {})

    def _frame(self, request: dict, client: Connection) -> Answer:
        options = {name: bool(request.get(name)) for name in ("draft", "clipped")}
        run, camera = self._run_of(request), camera_of(request["camera"])
        client.reserve(frame_bytes(camera, options["clipped"]))
        parts, pixels, frame = run.frame_parts(camera, **options), camera.pixel_count, None
        while frame is None:
            frame = self.on_renderer(client, partial(next, parts), pixels)
        return "application/octet-stream", frame

    def _edit(self, request: dict, client: Connection) -> Answer:
        edits = edits_of(request, partial(self._photos_of, index_of(request, "run", 0)))
        merged = [self._run_of({"run": index}) for index in json_list(request.get("merge", []), "merge")]
        history = history_of(request)
        return self._change(request, client, lambda run: run.edit(edits, merged, history))

    def _orient(self, request: dict, client: Connection) -> Answer:
        return self._change(request, client, partial(orient, request=request))

    def _change(self, request: dict, client: Connection, change: Callable[[ViewerScene], None]) -> Answer:
        """Change a run on the renderer's thread, and answer with its facts."""
        run = self._run_of(request)
        self.on_renderer(client, partial(change, run))
        run.version += 1  # Pages read up and scale again.
        return _json(run.facts())

    def _lights(self, request: dict, client: Connection) -> Answer:
        return _json(self.on_renderer(client, self._run_of(request).describe_lights))

    def _set_gain(self, request: dict, client: Connection) -> Answer:
        light, stops = index_of(request, "light"), number(request, "stops")
        self.on_renderer(client, partial(self._run_of(request).set_gain, light, stops))
        return self._lights(request, client)

    def _path(self, request: dict, client: Connection) -> Answer:
        return "application/json", camera_file(self._run_of(request), cameras_of(request)).encode()

    def close(self) -> None:
        """End the work for clients, and wait for it: native code must not run while Python ends."""
        self._closed.set()
        self._renderer.close()
        for lock in (self._save_lock, self._photo_lock):
            if lock.acquire(timeout=_SAVE_END):
                lock.release()

    def on_renderer(self, client: Connection, make: Callable[[], Any], pixels: int = 0) -> Any:
        """Return what `make` returns on the renderer's thread, if its client is still there; fewer pixels go first."""

        def call() -> Any:
            if self._closed.is_set() or client.is_closed():
                raise ClientGone
            return make()

        try:
            return self._renderer.call(call, pixels)
        except RuntimeError:
            if self._closed.is_set():
                raise ClientGone from None
            raise

    def _run_of(self, request: dict) -> ViewerScene:
        index = index_of(request, "run", 0)
        if not 0 <= index < len(self.runs):
            raise Refusal(404, "no such run")
        return self.runs[index]

    def _photos_of(self, index: int) -> list[Any]:
        """Return the photos of a run; raise SehdrError if they are gone."""
        with self._photo_lock:
            return list(self._photos(index).values())

    def _photo(self, name: str, client: Connection) -> bytes:
        """Return the photo of a run and a view by their indices, as PNG."""
        index, _, view = name.partition("/")
        if not (index.isascii() and view.isascii() and index.isdigit() and view.isdigit() and len(name) < 20):
            raise Refusal(404, "no such photo")
        run = self._run_of({"run": int(index)})
        if int(view) >= len(run.cameras):
            raise Refusal(404, "no such photo")
        with self._photo_lock:  # One at a time, because pictures of a large photo take much memory on the way.
            photo = self._photos(int(index)).get(run.cameras[int(view)].name)
            if photo is None or self._closed.is_set():
                raise Refusal(404, "no such photo")
            buffer = io.BytesIO()
            picture = Image.fromarray(quantize(photo_for_display(cast(Any, run), photo)))
            picture.save(buffer, "PNG", compress_level=1)
        client.reserve(buffer.tell())
        return buffer.getvalue()

    def _save(self, request: dict, client: Connection) -> Answer:
        """Return what a client saves: EXR, a zip of what `render` writes, a film or a page."""
        kind = choice(request, "kind", ("exr", "brackets", "film", "page"))
        cameras, stops = cameras_of(request), number(request, "stops") if request.get("stops") else 0.0
        run: Any = ClientRun(self.on_renderer, self._run_of(request), client)
        if not abs(stops) <= MOST_STOPS:  # NaN is not.
            raise Refusal(400, f"stops {stops} are not between -{MOST_STOPS:g} and {MOST_STOPS:g}")
        evs = str(request.get("evs") or "-4,-2,0,2,4") if kind == "brackets" else None
        pictures = len(evs.split(",")) + 1 if evs else 1
        pixels = pictures * sum(camera.pixel_count for camera in cameras)
        if kind != "film" and pixels > MOST_SAVED:
            raise Refusal(413, f"{pixels} pixels are more than the {MOST_SAVED} of a save; use sehdr-warp render")
        if not self._save_lock.acquire(blocking=False):
            raise Refusal(503, "another save is still being made")
        try:
            with tempfile.TemporaryDirectory() as folder:
                if kind == "page":
                    page = self.on_renderer(client, partial(write_scene_page, run, Path(folder, "scene.html")))
                    return "text/html", page.read_bytes()
                if kind == "film":
                    options = {"ev_ramp": (stops, stops), "exposed": True, "tell": self._tell}
                    return "video/mp4", write_film(run, Path(folder, "film.mp4"), cameras, **options).read_bytes()
                camera_path = Path(folder, "cameras.json")
                camera_path.write_text(camera_file(run, cameras), encoding="utf-8")
                files = render_views(run, Path(folder, "views"), cameras=camera_path, evs=evs)
                if kind == "exr" and len(cameras) == 1:
                    return "image/x-exr", files[0].read_bytes()
                packed = Path(folder, "views.zip")
                with zipfile.ZipFile(packed, "w") as archive:
                    for file in files:
                        archive.write(file, file.relative_to(folder))
                        file.unlink()
                client.reserve(packed.stat().st_size)
                return "application/zip", packed.read_bytes()
        finally:
            self.save_line = ""
            self._save_lock.release()

    def _tell(self, line: str) -> None:
        """Set the line that a page shows while a film is rendered."""
        self.save_line = line


def _json(value: Any) -> Answer:
    return "application/json", json.dumps(value).encode()


class Server(ThreadingHTTPServer):
    """The viewer's server on a port of a host; `url` is its address."""

    daemon_threads, block_on_close, request_queue_size = True, False, 64
    _listening = False  # A port that is in use closes the server, but not what it shows

    def __init__(self, viewer: Viewer, host: str = "127.0.0.1", port: int = 8080, origins: Sequence[str] = ()):
        """Listen on the port, or on the next free one.

        origins: of a proxy before this server, such as https://splats.example.org.
        """
        self.viewer, self.host, self.origins = viewer, host, tuple(origins)
        self.security_policy = f"{_POLICY}; frame-ancestors 'self' vscode-webview: {' '.join(self.origins)}".strip()
        self.connections = Connections()
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        for tried in range(port, min(port + PORTS_TRIED, 65536)):
            try:
                super().__init__((host, tried), _Handler)
                break
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    problem = f"cannot be served from ({error.strerror})"
                    raise SehdrError(f"{host}:{tried}: {problem}; choose another") from None
                log.info("port %d is in use", tried)
        else:
            raise SehdrError(f"--port {port}: no port from there on is free; choose another")
        self._listening = True
        place = f"[{host}]" if ":" in host else host
        self.url = f"http://{place}:{self.server_address[1]}/"

    def process_request(self, request, client_address) -> None:
        """Start a thread for a connection, unless there are too many."""
        if not self.connections.add(request):  # pyright: ignore[reportArgumentType]
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request, client_address) -> None:
        """Serve a connection and forget it at the end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.connections.remove(request)  # pyright: ignore[reportArgumentType]

    def server_close(self) -> None:
        """Close all connections and end the work for them."""
        super().server_close()
        if self._listening:
            self.connections.close()
            self.viewer.close()

    def handle_error(self, request, client_address) -> None:
        """Log a broken connection for debugging only."""
        log.debug("a connection of %s ended", client_address)

    def allowed(self, host: str, origin: str | None) -> bool:
        """Return whether a request comes from a page of this server: another site could reach it by another name."""
        name = re.sub(r":[0-9]*$", "", host)
        own = f"[{self.host}]" if ":" in self.host else self.host
        proxies = [each.partition("://")[2] for each in self.origins]
        reached = not is_local(self.host) or name in (*_LOCAL, own) or host in proxies
        return reached and origin in (None, f"http://{host}", f"https://{host}", *self.origins)


class _Handler(BaseHTTPRequestHandler):
    protocol_version, timeout, disable_nagle_algorithm = "HTTP/1.1", SILENCE, True
    error_message_format, error_content_type = "%(message)s", "text/plain"
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        self._answer(self.server.viewer.get)

    do_HEAD = do_GET

    def do_POST(self) -> None:
        self._answer(lambda path, client: self.server.viewer.post(path, self._body(client), client))

    def _body(self, client: Connection) -> dict:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and int(length) <= MOST_BODY):
            self.close_connection = True
            raise Refusal(413, f"a request says its length, of at most {MOST_BODY} bytes")
        with client.asking():
            data = self.rfile.read(int(length))
        if len(data) < int(length):
            raise ConnectionError
        if self.headers.get_content_type() != "application/json":
            raise Refusal(415, "a request is JSON")
        values = json.loads(data, parse_constant=_refuse_constant)
        if not isinstance(values, dict):
            raise Refusal(400, "a request is an object")
        return values

    def _answer(self, find: Callable[[str, Connection], Answer]) -> None:
        connections = self.server.connections
        try:
            connection = connections.of(self.connection)
        except ClientGone:
            self.close_connection = True
            return
        with connections.answering(connection):
            answer = self._result_of(partial(find, own_path(self.path), connection))
            self._send(connection, *answer)

    def _result_of(self, find: Callable[[], Answer]) -> tuple[int, str, bytes | memoryview]:
        """Return status, content type and content of an answer."""
        try:
            if not self.server.allowed(self.headers.get("Host", ""), self.headers.get("Origin")):
                self.close_connection = True
                remedy = "behind a proxy, start it with --origin https://ITS.NAME"
                raise Refusal(403, f"only pages of this server may ask; {remedy}")
            return 200, *find()
        except Refusal as error:
            return error.status, "text/plain", str(error).encode()
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            return 400, "text/plain", f"cannot be used: {damage(error)}".encode()
        except (RuntimeError, MemoryError) as error:  # For example, a GPU without room.
            return 500, "text/plain", f"cannot be rendered: {' '.join(str(error).split())[:200]}".encode()
        except BusyError as error:
            return 503, "text/plain", str(error).encode()
        except SehdrError as error:
            return 409, "text/plain", str(error).encode()
        except OSError:
            self.close_connection = True
            return 500, "text/plain", b"the request ended early"

    def _send(self, connection: Connection, status: int, kind: str, content: bytes | memoryview) -> None:
        try:
            self.send_response(status)
            policy = {"Content-Security-Policy": self.server.security_policy}
            of_content = {"Content-Type": kind, "Content-Length": str(len(content))}
            for name, value in {**_HEADERS, **policy, **of_content}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                connection.send(content)
        except OSError:  # The client has gone, or reads nothing.
            self.close_connection = True

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that is not HTTP, without quoting it."""
        super().send_error(code, None if message is None else message[:100], explain)

    def log_message(self, format: str, *args) -> None:
        log.debug(format, *args)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number")
