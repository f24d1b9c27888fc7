"""A CAN bus without CAN: a server that speaks socketcand's raw mode, for places where the kernel has no CAN and no multicast.

    python -m s2r_can.hub [--port PORT]        prints `PORT` once it listens

Each channel name that a client opens is a bus; what one client sends every other client of that channel hears. Classic frames only: the
protocol has no CAN FD. A client that does not read loses frames, as on a bus.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import selectors
import signal
import socket
import sys
import threading
import time
from types import FrameType

_COMMAND = re.compile(rb"<\s*([^<>]*?)\s*>")
CLIENT_BYTES = 1 << 16
"""What may wait for a client that is late; whole frames are dropped beyond."""
LINE_MAX = 4096
QUIET_S = 0.02
"""python-can's client takes the answer to its last command and a frame right behind it for a wrong answer."""


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        self.connection, self.channel, self.raw_from = connection, "", float("inf")
        self.incoming, self.outgoing = b"", b""


class Hub:
    """Serves from a thread of its own, between `start` and `close`. port 0: any that is free."""

    def __init__(self, port: int = 0) -> None:
        self._selector = selectors.DefaultSelector()
        self._server = socket.create_server(("127.0.0.1", port))
        self._server.setblocking(False)
        self.port = int(self._server.getsockname()[1])
        self._selector.register(self._server, selectors.EVENT_READ)
        self._clients: dict[socket.socket, _Client] = {}
        self._ending = False
        self._thread = threading.Thread(target=self.serve, name="can-hub", daemon=True)

    def start(self) -> Hub:
        """Begins to serve."""
        self._thread.start()
        return self

    def close(self) -> None:
        """Ends, and hangs up on everybody."""
        self._ending = True
        if self._thread.is_alive():
            self._thread.join(2.0)

    def serve(self) -> None:
        """Until `close`."""
        try:
            while not self._ending:
                for key, mask in self._selector.select(0.05):
                    if key.fileobj is self._server:
                        self._welcome()
                    else:
                        client = self._clients.get(key.fileobj)  # type: ignore[call-overload]
                        if client is not None:  # else it was dropped since, when another one's frame could not be sent to it
                            self._attend(client, mask)
        finally:
            for client in list(self._clients.values()):
                self._drop(client)
            self._selector.close()
            self._server.close()

    def _welcome(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._server.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = self._clients[connection] = _Client(connection)
            self._selector.register(connection, selectors.EVENT_READ)
            self._tell(client, b"< hi >")

    def _attend(self, client: _Client, mask: int) -> None:
        try:
            if mask & selectors.EVENT_WRITE:
                self._flush(client)
            if mask & selectors.EVENT_READ:
                data = client.connection.recv(65536)
                if not data:
                    raise ConnectionError
                self._hear(client, data)
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)

    def _hear(self, client: _Client, data: bytes) -> None:
        data = client.incoming + data
        end = 0
        for match in _COMMAND.finditer(data):
            end = match.end()
            self._obey(client, match.group(1).split())
        client.incoming = data[end:][-LINE_MAX:]

    def _obey(self, client: _Client, words: list[bytes]) -> None:
        match words:
            case [b"open", channel]:
                client.channel = channel.decode("ascii", "replace")
                self._tell(client, b"< ok >")
            case [b"rawmode"]:
                self._tell(client, b"< ok >")
                client.raw_from = time.monotonic() + QUIET_S
            case [b"send", identifier, length, *payload] if len(payload) == int(length, 16) <= 8:
                told = b"< frame %s %.6f %s >" % (identifier, time.time(), b"".join(byte.rjust(2, b"0") for byte in payload))
                self._spread(client, told)
            case [b"error", kind]:  # not of socketcand: a test's way to an error frame
                self._spread(client, b"< error %s %.6f >" % (kind, time.time()))
            case _:
                self._tell(client, b"< error unknown command >")

    def _spread(self, sender: _Client, line: bytes) -> None:
        now = time.monotonic()
        for other in list(self._clients.values()):
            if other is not sender and other.channel == sender.channel and other.raw_from <= now:
                self._tell(other, line)

    def _tell(self, client: _Client, line: bytes) -> None:
        if len(client.outgoing) + len(line) <= CLIENT_BYTES:
            client.outgoing += line
        try:
            self._flush(client)
        except OSError:
            self._drop(client)

    def _flush(self, client: _Client) -> None:
        with contextlib.suppress(BlockingIOError):
            while client.outgoing:
                client.outgoing = client.outgoing[client.connection.send(client.outgoing) :]
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.outgoing else 0)
        if client.connection in self._clients:
            self._selector.modify(client.connection, events)

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.connection, None) is not None:
            self._selector.unregister(client.connection)
            client.connection.close()


def main(argv: list[str] | None = None) -> int:
    """Serves until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(prog="python -m s2r_can.hub", description="A CAN bus without CAN: socketcand's raw mode on loopback.")
    parser.add_argument("--port", type=int, default=0, help="(default: any that is free)")
    hub = Hub(parser.parse_args(argv).port)

    def end(_signal: int, _frame: FrameType | None) -> None:
        hub._ending = True

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    print(hub.port, flush=True)
    hub.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
