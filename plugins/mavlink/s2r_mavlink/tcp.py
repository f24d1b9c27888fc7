"""TCP: a stream of frames. Connects (`tcp`), again and again, or waits for any number of others (`tcpin`).

What waits in a connection's send queue grows old: it is kept short, and where it is full the next frame is dropped. A frame that went out
in part is always finished first.
"""

from __future__ import annotations

import errno
import fcntl
import select
import socket
import struct
import termios
import time
from contextlib import suppress

from s2r_mavlink.endpoints import READ_COST, RETRY_NS, Address, Piece, Source, resolved
from s2r_mavlink.frames import LONGEST, Framer
from s2r_runtime.errors import ConfigError

CONNECT_NS = 2_000_000_000
SILENT_NS = 3_000_000_000
"""A robot sends a heartbeat every second; a connection on which nothing came for so long is dead, whatever TCP believes."""
UNSENT_MOST = 1024
"""Bytes in the send queue above which nothing is added: about fifteen commands."""
OTHERS = 8


class Connection:
    """One connected socket with its framer."""

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        with suppress(OSError):  # not there on every kind of stream
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = connected
        self.framer = Framer(datagrams=False)
        self.heard_ns = time.monotonic_ns()
        self._unfinished = b""

    def read(self, most: int) -> tuple[list[bytes], bool]:
        """Frames that came, and whether the connection still stands. most: bytes."""
        frames: list[bytes] = []
        taken = 0
        stands = True
        while taken < most:
            try:
                data = self.socket.recv(most - taken)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                stands = False
                break
            taken += max(len(data), READ_COST)
            frames += self.framer.feed(data)
        if frames:
            self.heard_ns = time.monotonic_ns()
        return frames, stands

    def write(self, frame: bytes) -> bool:
        """False if it was dropped."""
        try:
            if self._unfinished:
                self._unfinished = self._unfinished[self.socket.send(self._unfinished) :]
            if self._unfinished or self._unsent() > UNSENT_MOST:
                return False
            self._unfinished = frame[self.socket.send(frame) :]
            return True
        except OSError:  # full, or gone: `read` notices
            return False

    def _unsent(self) -> int:
        return int(struct.unpack("i", fcntl.ioctl(self.socket.fileno(), termios.TIOCOUTQ, b"\0" * 4))[0])


class TcpClient:
    """Interface: `endpoints.Endpoint`."""

    def __init__(self, text: str, address: Address) -> None:
        self.text, self._address = text, address
        self._poller: select.epoll | None = None
        self._trying: socket.socket | None = None
        self._connection: Connection | None = None
        self._next_ns = self._give_up_ns = 0
        self._where = ("", 0)
        self.malformed = self.overflowed = self.opened = 0

    def open(self, poller: select.epoll) -> None:
        """Begins to connect. Raises ConfigError for a host that nobody knows."""
        self._poller, self._where = poller, resolved(self.text, self._address)
        self.maintain(time.monotonic_ns())

    def maintain(self, now_ns: int) -> None:
        """Connects, or finds out whether it has."""
        if self._poller is None:
            return
        if self._connection is not None:
            if now_ns - self._connection.heard_ns > SILENT_NS:
                self._drop()
        elif self._trying is not None:
            self._look(now_ns)
        elif now_ns >= self._next_ns:
            self._next_ns, self._give_up_ns = now_ns + RETRY_NS, now_ns + CONNECT_NS
            self._trying = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._trying.setblocking(False)
            if self._trying.connect_ex(self._where) in (0, errno.EINPROGRESS):
                self._look(now_ns)
            else:
                self._abandon()

    def _look(self, now_ns: int) -> None:
        assert self._trying is not None  # noqa: S101 - the caller looked
        poller = select.poll()
        poller.register(self._trying, select.POLLOUT)
        if not poller.poll(0):
            if now_ns > self._give_up_ns:
                self._abandon()
            return
        if self._trying.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self._abandon()
            return
        assert self._poller is not None  # noqa: S101 - opened
        self._connection, self._trying = Connection(self._trying), None
        self._poller.register(self._connection.socket.fileno(), select.EPOLLIN)
        self.opened += 1

    def _abandon(self) -> None:
        if self._trying is not None:
            self._trying.close()
            self._trying = None

    def _drop(self) -> None:
        if self._connection is not None:
            self.malformed += self._connection.framer.malformed
            self._connection.framer.malformed = 0
            self._connection.socket.close()
            self._connection = None

    def descriptors(self) -> list[int]:
        """The connection's."""
        return [] if self._connection is None else [self._connection.socket.fileno()]

    def read(self, most: int) -> list[Piece]:
        """What came; drops a connection that ended."""
        if self._connection is None:
            return []
        frames, stands = self._connection.read(most)
        self.malformed += self._connection.framer.malformed
        self._connection.framer.malformed = 0
        if not stands:
            self._drop()
        return [Piece(self.text, time.monotonic_ns(), frames)] if frames else []

    def write(self, frame: bytes, source: Source | None = None) -> bool:
        """To the other side."""
        return self._connection is not None and self._connection.write(frame)

    def accept(self, source: Source, now_ns: int) -> bool:
        """There is nobody else at this line's end."""
        return True

    def is_other(self, source: Source) -> bool:
        """As `accept`: never."""
        return False

    def hear(self, source: Source) -> None:
        """As `accept`."""

    def close(self) -> None:
        """Ends the connection."""
        self._abandon()
        self._drop()
        self._poller = None
        self._next_ns = 0


class TcpServer:
    """Interface: `endpoints.Endpoint`. Serves several at once; one too many is sent away, unless another has long been silent."""

    def __init__(self, text: str, address: Address) -> None:
        self.text, self._address = text, address
        self._poller: select.epoll | None = None
        self._listener: socket.socket | None = None
        self._connections: dict[int, Connection] = {}
        self.malformed = self.overflowed = self.opened = 0

    def open(self, poller: select.epoll) -> None:
        """Binds. Raises ConfigError if that can't be done."""
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(resolved(self.text, self._address))
            listener.listen(OTHERS)
        except OSError as error:
            listener.close()
            raise ConfigError(f"transport: {self.text}: {error.strerror}") from None
        listener.setblocking(False)
        poller.register(listener.fileno(), select.EPOLLIN)
        self._poller, self._listener = poller, listener

    def maintain(self, now_ns: int) -> None:
        """Nothing: others come by themselves."""

    def descriptors(self) -> list[int]:
        """The listener's and each connection's."""
        return ([] if self._listener is None else [self._listener.fileno()]) + list(self._connections)

    def read(self, most: int) -> list[Piece]:
        """Takes in who came, and what came: from each its share."""
        self._welcome()
        pieces = []
        share = max(LONGEST, most // max(len(self._connections), 1))
        for number, connection in list(self._connections.items()):
            frames, stands = connection.read(share)
            self.malformed += connection.framer.malformed
            connection.framer.malformed = 0
            if frames:
                pieces.append(Piece(number, time.monotonic_ns(), frames))
            if not stands:
                connection.socket.close()
                del self._connections[number]
        return pieces

    def _welcome(self) -> None:
        while self._listener is not None:
            try:
                came, _ = self._listener.accept()
            except OSError:
                return
            if self._poller is None or not self._has_room():
                came.close()
                continue
            self._connections[came.fileno()] = Connection(came)
            self._poller.register(came.fileno(), select.EPOLLIN)
            self.opened += 1

    def _has_room(self) -> bool:
        """Whether one more may come; of those that say nothing the one that was silent longest gives way."""
        if len(self._connections) >= OTHERS:
            number = min(self._connections, key=lambda one: self._connections[one].heard_ns)
            if time.monotonic_ns() - self._connections[number].heard_ns <= SILENT_NS:
                return False
            self._connections.pop(number).socket.close()
        return True

    def write(self, frame: bytes, source: Source | None = None) -> bool:
        """To all, or to one."""
        wanted = [c for number, c in self._connections.items() if source is None or number == source]
        return sum(connection.write(frame) for connection in wanted) > 0

    def accept(self, source: Source, now_ns: int) -> bool:
        """Everybody may connect."""
        return True

    def is_other(self, source: Source) -> bool:
        """As `accept`: never."""
        return False

    def hear(self, source: Source) -> None:
        """As `accept`."""

    def close(self) -> None:
        """Ends everything."""
        for connection in self._connections.values():
            connection.socket.close()
        self._connections.clear()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._poller = None
