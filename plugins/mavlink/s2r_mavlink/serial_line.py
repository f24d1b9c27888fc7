"""A serial line, or a USB cable that looks like one: raw bytes, nobody else on it. Opened again after it was pulled out."""

from __future__ import annotations

import errno
import fcntl
import os
import select
import struct
import termios
import time

from s2r_mavlink.endpoints import READ_COST, RETRY_NS, Address, Piece, Source
from s2r_mavlink.frames import Framer
from s2r_runtime.errors import ConfigError

UNSENT_MOST = 256
"""Bytes in the send queue above which nothing is added: at 57600 baud 45 ms, four commands."""
NEVER = (errno.EACCES, errno.EPERM, errno.ENOTTY, errno.EISDIR)
"""Errors of opening a device that waiting does not fix."""


class SerialLine:
    """Interface: `endpoints.Endpoint`."""

    def __init__(self, text: str, address: Address) -> None:
        self.text, self._path, self._baud = text, address.where, getattr(termios, f"B{address.number}")
        self._framer = Framer(datagrams=False)
        self._poller: select.epoll | None = None
        self._line = -1
        self._retry_ns = 0
        self._unfinished = b""
        self.overflowed = self.opened = 0

    @property
    def malformed(self) -> int:
        """Stretches of bytes that were no frame."""
        return self._framer.malformed

    def open(self, poller: select.epoll) -> None:
        """Opens the device, if it is there. Raises ConfigError for one that is no serial line or may not be used."""
        self._poller = poller
        try:
            self._open()
        except OSError as error:
            if error.errno in NEVER:
                raise ConfigError(f"transport: {self.text}: {error.strerror}") from None

    def _open(self) -> None:
        assert self._poller is not None  # noqa: S101 - opened
        line = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            try:
                fcntl.ioctl(line, termios.TIOCEXCL)  # a second program on the line would read half of the frames
                raw = termios.CS8 | termios.CREAD | termios.CLOCAL
                control: list[bytes | int] = [0] * len(termios.tcgetattr(line)[6])
                control[termios.VMIN] = 1  # with 0, "nothing there" would look like the line's end
                termios.tcsetattr(line, termios.TCSANOW, [0, 0, raw, 0, self._baud, self._baud, control])
            except termios.error as error:
                raise OSError(error.args[0], error.args[1]) from None
            self._poller.register(line, select.EPOLLIN)
        except OSError:
            os.close(line)
            raise
        self._line, self._unfinished = line, b""
        self.opened += 1

    def maintain(self, now_ns: int) -> None:
        """Opens it again."""
        if self._line < 0 and self._poller is not None and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + RETRY_NS
            try:
                self._open()
            except OSError:
                return

    def descriptors(self) -> list[int]:
        """The line's."""
        return [] if self._line < 0 else [self._line]

    def read(self, most: int) -> list[Piece]:
        """What came; closes a line that is gone."""
        frames: list[bytes] = []
        taken = 0
        while self._line >= 0 and taken < most:
            try:
                data = os.read(self._line, most)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._shut()
                break
            taken += max(len(data), READ_COST)
            frames += self._framer.feed(data)
        return [Piece(self.text, time.monotonic_ns(), frames)] if frames else []

    def write(self, frame: bytes, source: Source | None = None) -> bool:
        """False if the line is full or gone."""
        if self._line < 0:
            return False
        try:
            if self._unfinished:
                self._unfinished = self._unfinished[os.write(self._line, self._unfinished) :]
            unsent = struct.unpack("i", fcntl.ioctl(self._line, termios.TIOCOUTQ, b"\0" * 4))[0]
            if self._unfinished or unsent > UNSENT_MOST:
                return False
            self._unfinished = frame[os.write(self._line, frame) :]
            return True
        except OSError:
            return False

    def accept(self, source: Source, now_ns: int) -> bool:
        """There is nobody else at a cable's end."""
        return True

    def is_other(self, source: Source) -> bool:
        """As `accept`: never."""
        return False

    def hear(self, source: Source) -> None:
        """As `accept`."""

    def _shut(self) -> None:
        if self._line >= 0:
            os.close(self._line)
            self._line = -1

    def close(self) -> None:
        """Closes the device."""
        self._shut()
        self._poller = None
