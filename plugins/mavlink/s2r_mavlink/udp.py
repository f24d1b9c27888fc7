"""UDP: a datagram holds whole frames. Waits at an address of its own (`udp`), or speaks to a given one (`udpout`).

Where it waits for one robot, the first address that shows itself to be that robot's is taken, and kept until it was silent for
`SILENT_NS`: another address with the same system id is another robot, or somebody who would like to be.
"""

from __future__ import annotations

import select
import socket
import struct
import time

from s2r_mavlink.endpoints import READ_COST, RETRY_NS, Address, Piece, Source, resolved
from s2r_mavlink.frames import Framer
from s2r_runtime.errors import ConfigError

SILENT_NS = 500_000_000
OTHERS = 8
"""Addresses served at an endpoint for many; the one that was silent longest gives way."""
RECEIVE_BUFFER = 1 << 20
DATAGRAM = 9216
"""Bytes of the longest that is read whole: a jumbo frame of Ethernet."""
SO_RXQ_OVFL = getattr(socket, "SO_RXQ_OVFL", 40)
"""Linux: a datagram comes with the number of those that were dropped before it (socket(7)); Python has no name for it."""


class Udp:
    """Interface: `endpoints.Endpoint`."""

    def __init__(self, text: str, address: Address, *, many: bool) -> None:
        self.text, self._address, self._many = text, address, many
        self._framer = Framer(datagrams=True)
        self._socket: socket.socket | None = None
        self._poller: select.epoll | None = None
        self._others: dict[Source, int] = {}
        self._heard: Source | None = None
        self._retry_ns = 0
        self._where = ("", 0)
        self.overflowed = self.opened = 0

    @property
    def malformed(self) -> int:
        """Stretches of bytes that were no frame."""
        return self._framer.malformed

    def open(self, poller: select.epoll) -> None:
        """Binds where it waits. Raises ConfigError if that can't be done."""
        self._poller, self._where = poller, resolved(self.text, self._address)
        if self._address.kind == "udpout":
            self.maintain(time.monotonic_ns())
            return
        try:
            self._use(self._made())
        except OSError as error:
            raise ConfigError(f"transport: {self.text}: {error.strerror}") from None

    def _made(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            made.setblocking(False)
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            made.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            if self._address.kind == "udpout":
                made.connect(self._where)  # the kernel keeps out what others send to this port
            else:
                made.bind(self._where)
        except OSError:
            made.close()
            raise
        return made

    def _use(self, made: socket.socket) -> None:
        assert self._poller is not None  # noqa: S101 - opened
        self._socket = made
        self._poller.register(made.fileno(), select.EPOLLIN)
        self.opened += 1

    def maintain(self, now_ns: int) -> None:
        """Tries to reach a host that had no address or route a moment ago."""
        if self._socket is None and self._poller is not None and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + RETRY_NS
            try:
                self._use(self._made())
            except OSError:
                return

    def descriptors(self) -> list[int]:
        """The socket's."""
        return [] if self._socket is None else [self._socket.fileno()]

    def read(self, most: int) -> list[Piece]:
        """The datagrams that wait."""
        pieces: list[Piece] = []
        if self._socket is None:
            return pieces
        receive, feed, clock = self._socket.recvfrom, self._framer.feed, time.monotonic_ns
        taken = self._count_overflow(pieces)
        while taken and taken < most:
            try:
                data, source = receive(DATAGRAM)
            except BlockingIOError:
                break
            except OSError:  # nobody listens there: an answer to something that was sent
                taken += READ_COST
                continue
            taken += max(len(data), READ_COST)
            frames = feed(data)
            if frames:
                pieces.append(Piece(source, clock(), frames))
        return pieces

    def _count_overflow(self, pieces: list[Piece]) -> int:
        """Takes the first datagram together with the kernel's count of those that it dropped; bytes taken."""
        assert self._socket is not None  # noqa: S101 - the caller looked
        try:
            data, extra, _, source = self._socket.recvmsg(DATAGRAM, 64)
        except BlockingIOError:
            return 0
        except OSError:
            return READ_COST
        for level, kind, value in extra:
            if level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL:
                self.overflowed = max(self.overflowed, struct.unpack_from("I", value)[0])
        frames = self._framer.feed(data)
        if frames:
            pieces.append(Piece(source, time.monotonic_ns(), frames))
        return max(len(data), READ_COST)

    def write(self, frame: bytes, source: Source | None = None) -> bool:
        """To the robot, or to all others, or to one of them."""
        if self._socket is None:
            return False
        try:
            if self._address.kind == "udpout":
                return self._socket.send(frame) == len(frame)
            targets = [source] if source is not None else list(self._others) or ([self._heard] if self._heard is not None else [])
            for target in targets:
                self._socket.sendto(frame, target)
            return bool(targets)
        except OSError:
            return False

    def accept(self, source: Source, now_ns: int) -> bool:
        """Whether this address may be the other side's; it is from then on."""
        if self._address.kind == "udpout" or source in self._others:
            self._others[source] = now_ns
            return True
        if not self._many:
            if any(now_ns - heard_ns <= SILENT_NS for heard_ns in self._others.values()):
                return False
            self._others.clear()
        elif len(self._others) >= OTHERS:
            del self._others[min(self._others, key=lambda other: self._others[other])]
        self._others[source] = now_ns
        return True

    def is_other(self, source: Source) -> bool:
        """Whether one was accepted, and this is another."""
        return self._address.kind != "udpout" and not self._many and bool(self._others) and source not in self._others

    def hear(self, source: Source) -> None:
        """Somebody who holds the key is there, but what came is old."""
        self._heard = source

    def close(self) -> None:
        """Closes the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._poller = None
        self._others.clear()
        self._heard = None
