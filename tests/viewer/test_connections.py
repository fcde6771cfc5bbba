"""The viewer under clients that never ask, never read, or leave: bounded memory, and others are served."""

import json
import socket
import threading
import time

import pytest

from sehdr_warp.viewer import connections
from sehdr_warp.viewer.server import MOST_SAVED, Server

from ..output.helpers import AnalyticRun, camera
from .test_server import ask, frame


def post(server, path, body):
    """A request whose answer nobody reads yet, into as little memory of the system as it gives."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(server.server_address[:2])
    data = json.dumps(body).encode()
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    client.sendall(f"{head}Content-Length: {len(data)}\r\n\r\n".encode() + data)
    return client


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_clients_that_never_read_make_room_for_others(serve, monkeypatch):
    monkeypatch.setattr(connections, "MOST_BYTES", 50 << 20)
    monkeypatch.setattr(connections, "STALL", 3.0)
    server, large, largest = serve(), camera(1600, 1200), 0
    deaf = [post(server, "/frame", {"camera": large.to_dict(), "clipped": True}) for _ in range(4)]
    watched = threading.Event()

    def watch():
        nonlocal largest
        while not watched.wait(0.005):
            largest = max(largest, sum(each.reserved_bytes for each in list(server.connections.by_socket.values())))

    watcher = threading.Thread(target=watch)
    watcher.start()
    until(lambda: largest > 20 << 20)
    for _ in range(3):
        started = time.monotonic()
        frame(server, camera(64, 48))
        assert time.monotonic() - started < 10
    until(lambda: all(not each.answering for each in list(server.connections.by_socket.values())), 60)
    watched.set()
    watcher.join()
    assert largest <= 50 << 20
    for client in deaf:
        client.close()


HEAD = b"POST /frame HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 4000000\r\n"


@pytest.mark.parametrize("text", [b"", b"GET /sc", HEAD, HEAD + b"\r\n{"], ids=["nothing", "line", "head", "body"])
def test_clients_that_never_end_a_request_make_room_for_others(serve, monkeypatch, text):
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 5)
    server, begun = serve(), []
    for _ in range(12):
        begun.append(socket.create_connection(server.server_address[:2]))
        begun[-1].sendall(text)
    time.sleep(0.2)
    started = time.monotonic()
    assert ask(server, "/scene")[0] == 200 and time.monotonic() - started < 5
    assert len(server.connections.by_socket) <= 5
    for client in begun:
        client.close()


class _Slow(AnalyticRun):
    """A run whose pictures take a moment."""

    renders = 0

    def render(self, camera, **options):
        self.renders += 1
        time.sleep(0.02)
        return super().render(camera, **options)


def slow(server):
    server.viewer.runs[0].run = run = _Slow()
    return run


@pytest.mark.parametrize("kind", ["exr", "brackets", "film"])
def test_a_save_ends_when_its_client_leaves(serve, kind):
    if kind == "film":
        pytest.importorskip("av")
    server, small = serve(), camera(16, 16).to_dict()
    run = slow(server)
    client = post(server, "/save", {"cameras": [small] * 2000, "kind": kind, "evs": "-1,0,1"})
    until(lambda: run.renders > 1)
    assert ask(server, "/save", {"cameras": [small], "kind": "exr"})[0] == 503
    client.close()
    until(lambda: ask(server, "/save", {"cameras": [small], "kind": "exr"})[0] == 200)
    assert run.renders < 1000


def test_the_end_of_the_server_ends_a_save(serve):
    server = Server(serve().viewer, port=0)
    run = slow(server)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    client = post(server, "/save", {"cameras": [camera(16, 16).to_dict()] * 2000, "kind": "exr"})
    until(lambda: run.renders > 1)
    server.shutdown()
    started = time.monotonic()
    server.server_close()
    ended, renders = time.monotonic(), run.renders
    assert ended - started < 10 and renders < 1000
    time.sleep(0.2)
    assert run.renders == renders
    client.close()


def test_room_is_reserved_until_the_end_of_an_answer(monkeypatch):
    monkeypatch.setattr(connections, "MOST_BYTES", 100)
    monkeypatch.setattr(connections, "ROOM_WAIT", 0.1)
    both, (first, second) = connections.Connections(), socket.socketpair()
    with first, second:
        assert both.add(first) and both.add(second)
        with both.answering(both.of(first)):
            both.reserve(both.of(first), 60)
            with pytest.raises(connections.BusyError):
                both.reserve(both.of(second), 60)
        both.reserve(both.of(second), 60)


def test_connections_that_are_answered_are_not_closed_for_others(monkeypatch):
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 1)
    few, (first, second) = connections.Connections(), socket.socketpair()
    with first, second:
        assert few.add(first)
        with few.answering(few.of(first)):
            assert not few.add(second) and few.of(first)
        assert few.add(second)


def test_a_save_that_would_fill_the_disk_is_refused(serve):
    large = camera(4096, 2304).to_dict()
    status, _, content = ask(serve(), "/save", {"cameras": [large] * 60, "kind": "exr"})
    assert status == 413 and str(MOST_SAVED).encode() in content
