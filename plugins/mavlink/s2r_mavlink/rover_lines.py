"""The robot's end of a line, as plain as can be: what the stand-in rover and the tests' robots write to and read from.

Nothing of it is shared with the transport's end. What can't be written at once is dropped, as an autopilot does whose buffer is full.
"""

from __future__ import annotations

import os
import socket
import termios
import tty
from contextlib import suppress
from typing import Protocol

from s2r_runtime.errors import ConfigError


class Line(Protocol):
    """Bytes out, bytes in; never blocks."""

    def descriptors(self) -> list[int]:
        """Readable when `read` has something, or somebody comes."""

    def write(self, data: bytes) -> bool:
        """False if it was dropped."""

    def read(self) -> bytes:
        """What came."""

    def close(self) -> None:
        """Frees everything; may be called twice."""


class UdpLine:
    """Speaks to one address."""

    def __init__(self, host: str, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((host, port))
        self.socket.setblocking(False)

    def descriptors(self) -> list[int]:
        """The socket's."""
        return [self.socket.fileno()]

    def write(self, data: bytes) -> bool:
        """One datagram."""
        try:
            return self.socket.send(data) == len(data)
        except OSError:  # nobody is there yet, or it is too long
            return False

    def read(self) -> bytes:
        """One datagram; nothing if there is none."""
        try:
            return self.socket.recv(65_536)
        except OSError:
            return b""

    def close(self) -> None:
        """Closes the socket."""
        self.socket.close()


class TcpServerLine:
    """Waits, and speaks to the one that came last, as ArduPilot's simulator does."""

    def __init__(self, host: str, port: int) -> None:
        self.listener = socket.create_server((host, port))
        self.listener.setblocking(False)
        self.connection: socket.socket | None = None
        self._rest = b""

    def descriptors(self) -> list[int]:
        """The listener's and the connection's."""
        return [self.listener.fileno()] + ([] if self.connection is None else [self.connection.fileno()])

    def _welcome(self) -> None:
        with suppress(OSError):
            came, _ = self.listener.accept()
            self.hang_up()
            came.setblocking(False)
            came.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.connection, self._rest = came, b""

    def write(self, data: bytes) -> bool:
        """A whole frame or nothing."""
        self._welcome()
        if self.connection is None:
            return False
        try:
            if self._rest:
                self._rest = self._rest[self.connection.send(self._rest) :]
            if self._rest:
                return False
            self._rest = data[self.connection.send(data) :]
            return True
        except BlockingIOError:
            return False
        except OSError:
            self.hang_up()
            return False

    def read(self) -> bytes:
        """What came."""
        self._welcome()
        if self.connection is None:
            return b""
        try:
            data = self.connection.recv(65_536)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.hang_up()
        return data

    def hang_up(self) -> None:
        """Ends the connection; the next may come."""
        if self.connection is not None:
            self.connection.close()
            self.connection = None

    def close(self) -> None:
        """Ends everything."""
        self.hang_up()
        self.listener.close()


class DescriptorLine:
    """A serial device by its path, or the master of a pseudo-terminal by its descriptor."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor, self._rest = descriptor, b""

    def descriptors(self) -> list[int]:
        """The device's."""
        return [] if self._descriptor < 0 else [self._descriptor]

    def write(self, data: bytes) -> bool:
        """A whole frame or nothing."""
        try:
            if self._rest:
                self._rest = self._rest[os.write(self._descriptor, self._rest) :]
            if self._rest:
                return False
            self._rest = data[os.write(self._descriptor, data) :]
            return True
        except OSError:
            return False

    def read(self) -> bytes:
        """What came. The other end may not have been opened yet."""
        try:
            return os.read(self._descriptor, 65_536)
        except OSError:
            return b""

    def close(self) -> None:
        """Closes the device."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def pseudo_terminal() -> tuple[DescriptorLine, str]:
    """The robot's end of a cable, and the path of the other end."""
    master, slave = os.openpty()
    tty.setraw(slave)  # until the transport does it: nothing is echoed
    path = os.ttyname(slave)
    os.close(slave)
    return DescriptorLine(master), path


def line_of(text: str) -> Line:
    """From `udpout:HOST:PORT`, `tcpin:HOST:PORT` or `serial:PATH[:BAUD]`. Raises ConfigError, OSError."""
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind == "udpout" and port.isdecimal():
        return UdpLine(host, int(port))
    if kind == "tcpin" and port.isdecimal():
        return TcpServerLine(host, int(port))
    if kind == "serial" and rest:
        path = host if port.isdecimal() and host else rest
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        with suppress(termios.error):
            tty.setraw(descriptor)
        return DescriptorLine(descriptor)
    raise ConfigError("must be udpout:HOST:PORT, tcpin:HOST:PORT or serial:PATH:BAUD")
