"""Where the other side is: `udp:HOST:PORT` (wait there), `udpout:HOST:PORT`, `tcp:HOST:PORT`, `tcpin:HOST:PORT` (wait), `serial:PATH:BAUD`.

The names are those of other MAVLink software (`udpin` is `udp`). An endpoint opens what it can and tries the rest again later: a cable is
plugged in, a simulator comes up. Nothing here blocks: what can't be written at once is dropped and counted by the caller, and what waits
inside a line is bounded, because an old command is worse than none.
"""

from __future__ import annotations

import re
import select
import socket
import termios
from typing import Any, NamedTuple, Protocol

from s2r_runtime.errors import ConfigError

Source = Any
"""Who sent it, as far as the line can tell: a UDP address, a TCP connection, the cable. Hashable."""

RETRY_NS = 200_000_000
"""Between two attempts to connect: a link heals within a second of its return."""
ROBOT_MOST, OTHERS_MOST, SHOWN_MOST = 32 << 10, 4 << 10, 8 << 10
"""Bytes taken at a time from the robot's line, and from each side of others, and shown to the others: no flood holds the gate's loop.
The robot's share is large, because old messages are dropped there, not acted on. A frame has 8 bytes or more, and costs 2 µs to judge, or
5 to pass on. `tools/bench_mavlink.py --only flood` measures whole turns.
"""
READ_COST = 64
"""Bytes that each read from a line counts as, at least: an empty datagram, or a single byte, costs as much to take."""


class Piece(NamedTuple):
    """Frames that came together."""

    source: Source
    arrival_ns: int
    frames: list[bytes]


class Endpoint(Protocol):
    """One line, maybe with several others at its end."""

    text: str

    @property
    def malformed(self) -> int:
        """Stretches of bytes that were no frame."""

    @property
    def overflowed(self) -> int:
        """Datagrams that the kernel dropped because they were not taken in time."""

    @property
    def opened(self) -> int:
        """How often a connection came about."""

    def open(self, poller: select.epoll) -> None:
        """Begins. Raises ConfigError for what can never work."""

    def maintain(self, now_ns: int) -> None:
        """Connects what isn't connected. Called at least every 20 ms."""

    def descriptors(self) -> list[int]:
        """Those that `read` serves at the moment."""

    def read(self, most: int) -> list[Piece]:
        """What came, until it is `most` bytes or a little more; never blocks. The rest comes with the next call."""

    def write(self, frame: bytes, source: Source | None = None) -> bool:
        """Hands a frame to the other side (to one of them only); False if it was dropped."""

    def accept(self, source: Source, now_ns: int) -> bool:
        """A frame of the other side came from there: whether it may. A line with one end always says yes."""

    def is_other(self, source: Source) -> bool:
        """Whether it is known that the other side speaks from elsewhere."""

    def hear(self, source: Source) -> None:
        """Whoever holds the key is there, though what came is old: what is sent goes there until somebody was accepted."""

    def close(self) -> None:
        """Frees everything; may be called twice."""


class Address(NamedTuple):
    """A parsed endpoint: kind, host or path, port or baud rate."""

    kind: str
    where: str
    number: int


_NETWORK = re.compile(r"(udp|udpin|udpout|tcp|tcpin):([^:\s]+):(\d{1,5})")
_SERIAL = re.compile(r"serial:([^:\s]+)(?::(\d+))?")
BAUD = 57_600
"""Of a telemetry radio, unless said otherwise."""


def parse(text: str) -> Address | str:
    """The endpoint, or what it must be."""
    if found := _NETWORK.fullmatch(text):
        kind = "udp" if found[1] == "udpin" else found[1]
        return Address(kind, found[2], int(found[3])) if 0 < int(found[3]) < 65_536 else "a port in 1 to 65535"
    if found := _SERIAL.fullmatch(text):
        baud = int(found[2] or BAUD)
        return Address("serial", found[1], baud) if hasattr(termios, f"B{baud}") else "a baud rate that this system knows, such as 57600"
    return "udp:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:PATH:BAUD"


def resolved(text: str, address: Address) -> tuple[str, int]:
    """The address to use. Names are looked up once, at the start: later that could hold up the robot. Raises ConfigError."""
    try:
        found = socket.getaddrinfo(address.where, address.number, socket.AF_INET)
    except OSError as error:
        raise ConfigError(f"transport: {text}: {address.where} is not known: {error.strerror}") from None
    host, port = found[0][4][:2]
    return str(host), int(port)


def endpoint(text: str, *, many: bool) -> Endpoint:
    """The endpoint that a checked option describes. many: any number of others may use it, not one."""
    from s2r_mavlink.serial_line import SerialLine
    from s2r_mavlink.tcp import TcpClient, TcpServer
    from s2r_mavlink.udp import Udp

    address = parse(text)
    assert isinstance(address, Address)  # noqa: S101 - options are checked before
    if address.kind == "serial":
        return SerialLine(text, address)
    if address.kind == "tcp":
        return TcpClient(text, address)
    if address.kind == "tcpin":
        return TcpServer(text, address)
    return Udp(text, address, many=many)
