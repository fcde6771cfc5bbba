"""Connections of the viewer's server: how many there are, and how much memory their answers take.

Clients may be silent, or ask and never read. A server that is full closes the connection that was idle for longest,
and an answer that finds no room closes those whose clients have stopped reading, so that others are served.
"""

import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from ..errors import SehdrError

MOST_CONNECTIONS = 100
MOST_BYTES = 64 << 20
"""Memory of all answers that are being made and sent; a single answer may be larger if there is no other."""
SILENCE = 60.0  # Seconds that a connection may be open without a request
STALL = 15.0  # Seconds that a client may read nothing of its answer
SHORT_STALL = 0.25  # The same, if others wait for the room that its answer takes
ROOM_WAIT = 20.0  # Seconds that an answer waits for room
_CHUNK = 1 << 18


class ClientGone(SehdrError):
    """The client of a request has closed its connection, or the server has: the answer is no longer needed."""

    def __init__(self):
        """Set the message."""
        super().__init__("the client has gone")


class BusyError(SehdrError):
    """There is no room for an answer at the moment."""

    def __init__(self):
        """Set the message."""
        super().__init__("the viewer is busy; ask again")


class Connection:
    """One connection: what it does, since when, and how many bytes of answers it holds."""

    def __init__(self, client: socket.socket, others: "Connections"):
        """Wrap the socket of a client; `others` are all open connections of the server."""
        self.socket, self._others = client, others
        self.answering = self.sending = self.receiving = self.closed = False
        self.since, self.reserved_bytes = time.monotonic(), 0

    def close(self) -> None:
        """Shut the connection, which ends the thread that serves it."""
        self.closed = True
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def reserve(self, size: int) -> None:
        """Wait for room for an answer of so many bytes; see Connections.reserve."""
        self._others.reserve(self, size)

    def is_closed(self) -> bool:
        """Return whether the client has closed the connection."""
        if self.closed:
            return True
        try:
            readable, _, _ = select.select([self.socket], [], [], 0)
            return bool(readable) and self.socket.recv(1, socket.MSG_PEEK) == b""
        except (OSError, ValueError):
            return True

    def send(self, content: bytes | memoryview) -> None:
        """Send an answer; raise OSError if the client reads nothing for STALL seconds."""
        self.socket.settimeout(STALL)
        self.since, self.sending = time.monotonic(), True
        try:
            view = memoryview(content)
            while len(view):
                view = view[self.socket.send(view[:_CHUNK]) :]
                self.since = time.monotonic()
        finally:
            self.sending = False
            self.socket.settimeout(SILENCE)

    def idle_for(self, now: float) -> float:
        """Return the seconds that nothing has been asked, or not all; negative while an answer is made."""
        return -1.0 if self.answering and not self.receiving else now - self.since

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Count as idle while a request is received, which its client may never end."""
        self.since, self.receiving = time.monotonic(), True
        try:
            yield
        finally:
            self.receiving = False

    def stalled_for(self, now: float) -> float:
        """Return the seconds that the client has read nothing of its answer; negative if none is being sent."""
        return now - self.since if self.sending else -1.0


class Connections:
    """The open connections of a server.

    Attributes:
        by_socket: Each connection by the socket of its client.
    """

    def __init__(self) -> None:
        """Begin without connections."""
        self.by_socket: dict[socket.socket, Connection] = {}
        self._changed = threading.Condition()

    def add(self, client: socket.socket) -> bool:
        """Register a connection; return False if there are too many and each of them is being answered."""
        with self._changed:
            if len(self.by_socket) >= MOST_CONNECTIONS:
                now = time.monotonic()
                idle = max(self.by_socket.values(), key=lambda each: each.idle_for(now))
                if idle.idle_for(now) < 0:
                    return False
                del self.by_socket[idle.socket]
                idle.close()
            self.by_socket[client] = Connection(client, self)
            return True

    def remove(self, client: socket.socket) -> None:
        """Forget a connection that has ended."""
        with self._changed:
            self.by_socket.pop(client, None)
            self._changed.notify_all()

    def of(self, client: socket.socket) -> Connection:
        """Return the connection of a socket; raise ClientGone if it was closed for another."""
        with self._changed:
            try:
                return self.by_socket[client]
            except KeyError:
                raise ClientGone from None

    def close(self) -> None:
        """Close all connections."""
        with self._changed:
            for each in self.by_socket.values():
                each.close()

    @contextmanager
    def answering(self, connection: Connection) -> Iterator[None]:
        """Count a connection as busy meanwhile, and release the room that its answer took at the end."""
        connection.answering = True
        try:
            yield
        finally:
            with self._changed:
                connection.answering, connection.reserved_bytes, connection.since = False, 0, time.monotonic()
                self._changed.notify_all()

    def reserve(self, connection: Connection, size: int) -> None:
        """Wait until there is room for `size` more bytes of an answer; close stalled connections to make some.

        Raises BusyError if there is none after a while.
        """
        end = time.monotonic() + ROOM_WAIT
        with self._changed:
            while (
                by_others := sum(each.reserved_bytes for each in self.by_socket.values() if each is not connection)
            ) and by_others + connection.reserved_bytes + size > MOST_BYTES:
                now = time.monotonic()
                if now > end:
                    raise BusyError
                stalled = max(self.by_socket.values(), key=lambda each: each.stalled_for(now))
                if stalled is not connection and stalled.stalled_for(now) > SHORT_STALL:
                    stalled.close()
                    stalled.since = now  # Its thread takes a moment to end.
                self._changed.wait(SHORT_STALL / 2)
            connection.reserved_bytes += size
