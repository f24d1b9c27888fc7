"""A door before a WebSocket server: who may open a connection, by the `Origin` of the page that opens it (RFC 6455, section 10.2).

Any page in a browser on this machine can open a WebSocket to a port of it; the browser says which page it is in `Origin`. The Foxglove SDK
(0.30) does not look at that. So its server listens at an address of the loopback network that was drawn at random (40 bits with the port),
and what comes to the public port is looked at here first, and then handed on as it is. A client that reads slowly is read for slowly: the
server behind drops what it then has too much of.

The SDK calls the protocol `foxglove.sdk.v1` and refuses `foxglove.websocket.v1`, which earlier viewers alone know.
What it sends is the same, so for those the name is exchanged.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import threading
from collections.abc import Collection
from urllib.parse import urlsplit

from s2r_runtime.errors import UsageError

HEAD_MAX = 16 << 10
"""Bytes of a request's head."""
HEAD_S = 5.0
"""In which the head must be there."""
CLIENTS_MAX = 32
BUFFER = 64 << 10
"""Bytes that wait for a client here, and about the same again in the kernel."""
APPS = ("https://app.foxglove.dev", "file://")
"""Foxglove's web application; the desktop applications of Foxglove and Lichtblick."""
OLD, NEW = b"foxglove.websocket.v1", b"foxglove.sdk.v1"
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_BUSY = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


Side = tuple[asyncio.StreamReader, asyncio.StreamWriter]


def random_loopback() -> str:
    """An address of 127.0.0.0/8 that nobody can guess."""
    return ".".join(("127", *(str(1 + secrets.randbelow(254)) for _ in range(3))))


class Door:
    """Listens at host:port in a thread of its own and hands on to `behind`. allowed: origins besides `APPS` and pages of this machine.

    Raises UsageError if the port is taken or the address is not this machine's.
    """

    def __init__(self, host: str, port: int, behind: tuple[str, int], allowed: Collection[str] = ()) -> None:
        self._behind, self._allowed = behind, {*APPS, *(origin.rstrip("/") for origin in allowed)}
        self.refused = 0
        """Connections that were refused for their origin or for what they began with."""
        self._open = 0
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._serve, host, port, limit=HEAD_MAX))
        except OSError as error:
            self._loop.close()
            raise UsageError(f"{host}:{port}: cannot be listened on: {_why(error)}; choose another port") from None
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="door", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it, and all connections; may be called twice."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._server.close)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(5.0)
            left = asyncio.all_tasks(self._loop)
            for task in left:
                task.cancel()
            self._loop.run_until_complete(asyncio.wait(left, timeout=1.0) if left else asyncio.sleep(0))
            self._loop.run_until_complete(asyncio.sleep(0))  # transports that were closed are freed in the next turn
            self._loop.close()

    def may(self, origin: str | None) -> bool:
        """Whether a page of this origin may look. None: it is no page but a program."""
        if origin is None or origin in self._allowed:
            return True
        try:
            url = urlsplit(origin)
        except ValueError:
            return False
        return url.scheme in {"http", "https"} and _is_loopback(url.hostname or "")

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open += 1
        try:
            head = await self._head(reader)
            if head is None or self._open > CLIENTS_MAX:
                self.refused += 1
                writer.write(_REFUSED if head is None else _BUSY)
                await writer.drain()
                return
            theirs, ours = await asyncio.open_connection(*self._behind)
            try:
                await self._between(head, (reader, writer), (theirs, ours))
            finally:
                ours.transport.abort()
        except (OSError, EOFError, asyncio.CancelledError, asyncio.LimitOverrunError):
            pass
        finally:
            self._open -= 1
            with contextlib.suppress(OSError, RuntimeError):
                if writer.transport.get_write_buffer_size():  # it does not read: nobody waits for that
                    writer.transport.abort()
                writer.close()

    async def _between(self, head: bytes, client: Side, server: Side) -> None:
        """Hands on what comes from either side, until one of them ends."""
        (reader, writer), (theirs, ours) = client, server
        for one in (writer, ours):
            one.transport.set_write_buffer_limits(high=BUFFER)
        old = OLD in head and NEW not in head
        ours.write(head.replace(OLD, NEW) if old else head)
        answer = await asyncio.wait_for(theirs.readuntil(b"\r\n\r\n"), HEAD_S)
        writer.write(answer.replace(NEW, OLD) if old else answer)
        ways = [asyncio.ensure_future(_pipe(reader, ours)), asyncio.ensure_future(_pipe(theirs, writer))]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)

    async def _head(self, reader: asyncio.StreamReader) -> bytes | None:
        """The request's head if it is a WebSocket's and its origin may look."""
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
            return None
        first, *lines = head.decode("latin-1").split("\r\n")
        fields = [(name.strip().lower(), value.strip()) for name, found, value in (line.partition(":") for line in lines) if found]
        origins = [value for name, value in fields if name == "origin"]
        upgrades = any(name == "upgrade" and value.lower() == "websocket" for name, value in fields)
        fits = first.startswith("GET ") and upgrades and len(origins) < 2
        return head if fits and self.may(origins[0] if origins else None) else None


async def _pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(BUFFER):
        writer.write(data)
        await writer.drain()


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _why(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
