"""Clients of requests, the paths that they ask for, and the answer to a request that is refused."""

import ipaddress
import re
from contextlib import AbstractContextManager

from .connections import Connection, Connections


class Refusal(Exception):
    """An error answer: an HTTP status and one line."""

    def __init__(self, status: int, line: str):
        """Set the status and the line."""
        self.status = status
        super().__init__(line)


class Client:
    """Client of a request, with what the request may know of its connection."""

    def __init__(self, connections: Connections, connection: Connection):
        """Set the connection and those beside it."""
        self._connections, self._connection = connections, connection

    def is_closed(self) -> bool:
        """Return whether the client no longer waits for the answer."""
        return self._connection.is_closed()

    def reserve(self, size: int) -> None:
        """Wait for room for an answer of so many bytes; see Connections.reserve."""
        self._connections.reserve(self._connection, size)

    def asking(self) -> AbstractContextManager[None]:
        """Return a context in which the request is received; see Connection.asking."""
        return self._connection.asking()


def own_path(path: str) -> str:
    """Return the path of a request without its query, and without the prefix that some proxies leave there."""
    match = re.search(r"/(photo/[^/]+/[^/]+|[^/]*)$", path.partition("?")[0])
    return match[0] if match else path


def is_local(host: str) -> bool:
    """Return whether only this machine reaches a host's name or address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")
