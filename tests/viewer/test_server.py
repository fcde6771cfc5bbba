"""The viewer's server as browsers and others ask it: frames, files, refusals, and that it stays up."""

import http.client
import io
import json
import re
import socket
import threading
import zipfile

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.scene import load_cameras, look_at
from sehdr_warp.viewer.clients import MOST_VIEWS
from sehdr_warp.viewer.server import MOST_BODY, Server, Viewer

from ..output.helpers import camera, make, read_exr


def ask(server, path, body=None, method=None, **headers):
    """Status, content type and content of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=30)
    data = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    known = {} if data is None else {"Content-Type": "application/json"}
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method or ("GET" if data is None else "POST"), path, data, known | named)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, answer.headers.get_content_type(), content


def frame(server, view, **options):
    """Planes of a frame: light and confidence, depth, and perhaps the share of clipped values."""
    status, _, content = ask(server, "/frame", {"run": 0, "camera": view.to_dict(), **options})
    assert status == 200, content
    planes, size = np.frombuffer(content, "<f2").astype(np.float32), view.width * view.height
    return planes[: 4 * size].reshape(view.height, view.width, 4), planes[4 * size : 5 * size], planes[5 * size :]


def test_cameras_of_a_turned_file_are_saved_in_the_photos_coordinates(serve, tmp_path):
    server, view = serve(), camera(33, 21)
    matrix = WorldTransform(np.diag([-1.0, -1.0, 1.0]), np.array([1.0, 2.0, 3.0]), 2.0).matrix
    run = server.viewer.runs[0].run
    run.world_matrix, run.path = matrix, str(tmp_path / "turned.ply")
    saved = ask(server, "/path", {"cameras": [view.to_dict()]})[2]
    (tmp_path / "path.json").write_bytes(saved)
    [(_, photo)] = load_cameras(tmp_path / "path.json")
    np.testing.assert_allclose(matrix[:3] @ [*photo.position, 1], view.position, atol=1e-9)
    [(_, back)] = select_cameras(run, tmp_path / "path.json")
    np.testing.assert_allclose(back.world_to_camera, view.world_to_camera, atol=1e-9)


def test_a_frame_is_the_render(serve):
    server, view = serve(), camera(33, 21)
    run = server.viewer.runs[0].run
    light, depth, clipped = frame(server, view, clipped=True)
    rendered = run.render(view)
    np.testing.assert_allclose(light[..., :3], rendered.hdr * run.base_time, rtol=1e-3)
    np.testing.assert_allclose(light[..., 3], run.render_confidence(view), atol=1e-3)
    np.testing.assert_allclose(depth.reshape(21, 33), rendered.depth, rtol=1e-3)
    assert (clipped == 0.25).all() and clipped.size == 33 * 21
    draft, _, none = frame(server, view, draft=True)
    assert (draft[..., 3] == 1).all() and not none.size
    run.render_confidence = lambda camera: None
    assert (frame(server, view)[0][..., 3] == -1).all(), "as of a file"


def test_the_page_its_facts_and_photos(serve):
    server = serve(count=2)
    for path in ("/", "/viewer.css", "/tables.js", "/light.js", "/camera.js", "/viewer.js"):
        status, kind, content = ask(server, path)
        assert status == 200 and kind.startswith("text/")
        assert not re.findall(rb"(?:src|href)=\"(?:https?:)?//|@import|url\(", content)
    facts = json.loads(ask(server, "/scene")[2])
    assert [run["name"] for run in facts["runs"]] == ["run 0", "run 1"] and not facts["training"]
    assert [view["name"] for view in facts["runs"][0]["views"]] == ["v_0", "v_1", "v_2"]
    picture = np.asarray(Image.open(io.BytesIO(ask(server, "/photo/0/1")[2])))
    view = make(None)[1].views[1]
    np.testing.assert_allclose(picture / 255, view.image, atol=0.5 / 255 + 1e-6)


def test_what_is_saved_is_what_render_writes(serve, tmp_path):
    server, view = serve(), camera(24, 16)
    hdr = server.viewer.runs[0].run.render(view).hdr
    payload = {"cameras": [view.to_dict()], "kind": "exr"}
    (tmp_path / "view.exr").write_bytes(ask(server, "/save", payload)[2])
    pixels, names, header = read_exr(tmp_path / "view.exr")
    np.testing.assert_allclose(pixels[..., :3], hdr, rtol=1e-3)
    assert names[:4] == ("R", "G", "B", "A") and "worldToCamera" in header
    with zipfile.ZipFile(
        io.BytesIO(ask(server, "/save", payload | {"kind": "brackets", "evs": "-2,0,2"})[2])
    ) as packed:
        assert sum(name.endswith(".exr") for name in packed.namelist()) == 4
    other = view.to_dict() | {"world_to_camera": look_at((1, 0, -3)).tolist()}
    path = json.loads(ask(server, "/path", {"cameras": [view.to_dict(), other], "count": 9})[2])
    assert len(path["cameras"]) == 9 and path["cameras"][0]["name"] == "view_000"
    if pytest.importorskip("av"):
        run = server.viewer.runs[0].run
        progress_lines, render = [], run.render

        def watched(*arguments, **options):
            progress_lines.append(ask(server, "/saving")[2].decode())
            return render(*arguments, **options)

        run.render = watched
        film = ask(server, "/save", {"cameras": [view.to_dict(), other], "kind": "film", "count": 3, "stops": -1})
        assert film[:2] == (200, "video/mp4") and b"ftyp" in film[2][:16]
        lines = [line.partition(", ")[0] for line in progress_lines]
        assert lines == ["", "film.mp4: frames: 1 of 3", "film.mp4: frames: 2 of 3"]
        assert ask(server, "/saving")[2] == b""


@pytest.mark.parametrize(
    "path, body, status",
    [
        ("/../../etc/passwd", None, 404),
        ("/photo/0/../../../etc/passwd", None, 404),
        ("/photo/9/0", None, 404),
        ("/photo/0/99", None, 404),
        ("/photo/-1/0", None, 404),
        ("/%2e%2e/secret", None, 404),
        ("/frame", b"{", 400),
        ("/frame", b"[1]", 400),
        ("/frame", b"[" * 100_000, 400),
        ("/frame", {}, 400),
        ("/frame", {"run": 7, "camera": {}}, 404),
        ("/frame", {"run": "x", "camera": {}}, 400),
        ("/frame", {"camera": camera().to_dict() | {"width": 10**9}}, 400),
        ("/frame", {"camera": camera().to_dict() | {"fx": float("nan")}}, 400),
        ("/frame", {"camera": camera().to_dict() | {"world_to_camera": [[0] * 4] * 4}}, 400),
        ("/save", {"cameras": [camera().to_dict()], "kind": "brackets", "evs": "x"}, 409),
        ("/save", {"cameras": [], "kind": "exr"}, 400),
        ("/path", {"cameras": [camera().to_dict()], "count": "many"}, 400),
        ("/training", {"do": "pause"}, 404),
        *(
            ("/save", {"cameras": [camera().to_dict()], "kind": "film", "stops": stops}, 400)
            for stops in (float("nan"), float("inf"), 1e300, -31, "1e400", [1])
        ),
    ],
)
def test_bad_questions_are_answered_in_a_line(serve, path, body, status):
    server = serve()
    replies, kind, content = ask(server, path, body)
    assert replies == status and kind == "text/plain" and b"\n" not in content and len(content) < 400
    assert ask(server, "/scene")[0] == 200


@pytest.mark.parametrize(
    "kind, words", [("png", "'png'"), ("EXR", "'EXR'"), ("", "''"), (None, "null"), (1, "1"), (["exr"], "a list of 1")]
)
def test_a_kind_that_is_not_saved_is_refused_with_those_that_are(serve, kind, words):
    status, _, content = ask(serve(), "/save", {"cameras": [camera().to_dict()], "kind": kind})
    assert (status, content.decode()) == (400, f"kind is {words}, not one of exr, brackets, film, page")


VIEW = camera().to_dict()


@pytest.mark.parametrize(
    "path, body, words",
    [
        ("/frame", {}, "camera is missing"),
        ("/frame", {"camera": [1, 2]}, "the camera is a list of 2, not an object"),
        ("/frame", {"camera": {"width": 8}}, "height is missing"),
        ("/frame", {"camera": VIEW | {"fx": None}}, "fx is null, not a number"),
        ("/frame", {"camera": VIEW | {"world_to_camera": [[1, 2], [3]]}}, "world_to_camera holds 3 numbers, not 4 x 4"),
        ("/frame", {"camera": VIEW, "run": "x"}, "run is 'x', not a whole number"),
        ("/frame", {"camera": VIEW, "run": 0.5}, "run is 0.5, not a whole number"),
        ("/path", {"cameras": "x"}, "cameras is 'x', not a list"),
        ("/path", {"cameras": [VIEW], "count": 2.5}, "count is 2.5, not a whole number"),
        ("/save", {"cameras": [VIEW], "kind": "film", "stops": {"a": 1}}, "stops is an object, not a number"),
        ("/edit", {"crop": [1, 2]}, "crop is a list of 2, not a text"),
        ("/edit", {"min_views": 2.5}, "min_views is 2.5, not a whole number"),
        ("/edit", {"merge": 1}, "merge is 1, not a list"),
        ("/orientation", {"up": [1, "x", 0]}, "up holds 'x', not one list of numbers"),
        ("/orientation", {"scale": []}, "scale is a list of 0, not a number"),
        ("/gain", {"stops": 1}, "light is missing"),
        ("/gain", {"light": 0, "stops": None}, "stops is null, not a number"),
    ],
)
def test_a_value_of_another_type_is_named(serve, path, body, words):
    status, _, content = ask(serve(), path, body)
    assert status == 400 and content.decode().startswith(f"cannot be used: {words}")


def test_other_sites_may_not_ask(serve):
    server, good = serve(), {"camera": camera().to_dict()}
    port = server.server_address[1]
    assert ask(server, "/frame", good, Origin=f"http://127.0.0.1:{port}")[0] == 200
    assert ask(server, "/frame", good, Origin="http://evil.example")[0] == 403
    assert ask(server, "/scene", Host=f"evil.example:{port}")[0] == 403  # A name that was made to lead here
    assert ask(server, "/scene", Host=f"localhost:{port}")[0] == 200
    assert ask(server, "/frame", json.dumps(good).encode(), Content_Type="text/plain")[0] == 415
    assert ask(server, "/scene", method="DELETE")[0] == 501


def test_sizes_are_bounded(serve):
    server = serve()
    with socket.create_connection(server.server_address[:2], timeout=10) as connection:
        host = f"127.0.0.1:{server.server_address[1]}"
        connection.sendall(f"POST /frame HTTP/1.1\r\nHost: {host}\r\nContent-Length: {MOST_BODY + 1}\r\n\r\n".encode())
        assert b" 413 " in connection.recv(4096)
    with socket.create_connection(server.server_address[:2], timeout=10) as connection:
        connection.sendall(b"GET /" + b"a" * 70_000)
        assert b" 414 " in connection.recv(4096)
    many = {"cameras": [camera(8, 8).to_dict()] * 2, "count": 10**9}
    assert len(json.loads(ask(server, "/path", many)[2])["cameras"]) == MOST_VIEWS


def test_twenty_clients_and_some_that_leave(serve):
    server, view, replies = serve(), camera(64, 48), []
    body = json.dumps({"camera": view.to_dict()})

    def look(number):
        if number % 4 == 0:  # Leaves before the answer.
            with socket.create_connection(server.server_address[:2]) as connection:
                head = "POST /frame HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
                connection.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode())
            return
        replies.append(frame(server, view)[0])

    clients = [threading.Thread(target=look, args=(number,)) for number in range(20)]
    for client in clients:
        client.start()
    for client in clients:
        client.join(60)
    assert len(replies) == 15 and all((each == replies[0]).all() for each in replies)
    assert ask(server, "/scene")[0] == 200


def test_a_taken_port_leads_to_the_next(serve, logged):
    first, second = serve(), serve()
    assert second.server_address[1] > first.server_address[1] and f":{second.server_address[1]}/" in second.url
    assert any("is in use" in line for line in logged)
    frame(second, camera(33, 21))  # The ports that were tried before did not end what is shown.


def test_photos_that_are_gone_are_named(serve):
    def gone(index):
        raise InputError("photos", "are no longer here", "say where")

    server = serve(photos=gone)
    assert ask(server, "/photo/0/0")[::2] == (409, b"photos: are no longer here; say where")


PUBLIC = "splats.example.org"


@pytest.fixture
def statuses(serve, monkeypatch):
    """Statuses of /scene for headers, by a server with or without a proxy's origin."""

    def of(origins=(), host="127.0.0.1"):
        server = serve()
        server.origins, server.host = origins, host
        port = server.server_address[1]
        cases = {
            "tunnel": {"Host": "localhost:8080", "Origin": "http://localhost:8080"},
            "tls tunnel": {"Host": "localhost:8443", "Origin": "https://localhost:8443"},
            "proxy": {"Host": PUBLIC, "Origin": f"https://{PUBLIC}"},
            "proxy that rewrites the host": {"Host": f"127.0.0.1:{port}", "Origin": f"https://{PUBLIC}"},
            "another site": {"Host": f"127.0.0.1:{port}", "Origin": "http://evil.example"},
            "another site by a name of its own": {"Host": "evil.example", "Origin": "http://evil.example"},
        }
        return {name: ask(server, "/scene", **headers)[0] for name, headers in cases.items()}

    return of


def test_a_local_viewer_answers_its_own_names(statuses):
    assert list(statuses().values()) == [200, 200, 403, 403, 403, 403]


def test_origin_lets_a_proxy_in_and_nobody_else(statuses):
    assert list(statuses(origins=(f"https://{PUBLIC}",)).values()) == [200, 200, 200, 200, 403, 403]


def test_a_viewer_of_the_network_answers_https_of_the_same_host(statuses):
    codes = statuses(host="0.0.0.0")
    assert codes["proxy"] == 200 and codes["another site"] == 403 and codes["proxy that rewrites the host"] == 403


def test_queries_are_ignored_and_addresses_are_relative(serve):
    server = serve()
    assert ask(server, "/?vscodeBrowserReqId=1")[0] == 200
    assert ask(server, "/scene?x=/../secret")[0] == 200
    page = ask(server, "/")[2].decode()
    script = ask(server, "/viewer.js")[2].decode()
    assert 'src="/' not in page and 'href="/' not in page and 'ask("/' not in script and "ask(`/" not in script


@pytest.mark.parametrize("prefix", ["/proxy/absolute/7007", "/user/me"])
def test_a_prefix_that_a_proxy_leaves_does_not_matter(serve, prefix):
    """jupyter-server-proxy's /proxy/absolute/PORT/ and nginx without a trailing slash; visdom pull request 978."""
    server = serve()
    for path in ("/", "/viewer.js", "/scene", "/photo/0/1"):
        assert ask(server, prefix + path)[0::2] == ask(server, path)[0::2]
    assert ask(server, f"{prefix}/nothing")[0] == 404


def test_head_is_a_get_without_content(serve):
    status, kind, content = ask(serve(), "/", method="HEAD")
    assert (status, kind, content) == (200, "text/html", b"")
    assert ask(serve(), "/nothing", method="HEAD")[0] == 404


def test_a_refusal_names_the_way_out(serve):
    status, _, content = ask(serve(), "/scene", Origin="https://evil.example")
    assert status == 403 and b"--origin https://ITS.NAME" in content


def test_previews_may_frame_the_page_and_sites_may_not():
    server = Server(Viewer([]), port=18300, origins=("https://a.example",))
    server.server_close()
    ancestors = server.security_policy.partition("frame-ancestors")[2].split()
    assert ancestors == ["'self'", "vscode-webview:", "https://a.example"]


@pytest.mark.parametrize("host", ["127.0.0.2", "localhost", "127.0.0.1"])
def test_a_server_for_this_machine_alone_has_no_other_names(serve, host):
    try:
        server = Server(serve().viewer, host, 0)
    except OSError:
        pytest.skip(f"{host} is no address here")
    port = server.server_address[1]
    for name in (host, f"{host}:{port}", f"localhost:{port}", "[::1]:1"):
        assert server.allowed(name, None)
    for name in (
        "",
        "evil.example",
        f"evil.example:{port}",
        "127.0.0.2.evil.example",
        f"localhost.evil:{port}",
        "[::2]",
    ):
        assert not server.allowed(name, None)
    assert not server.allowed(f"{host}:{port}", "http://evil.example")
    server.server_close()
