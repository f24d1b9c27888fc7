"""One run's log on the disk, block by block: seals, compresses, appends, completes, and begins the next part.

After an error of the operating system the file is as it was, and the same call tries the same bytes again.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import threading
import time
import zlib
from array import array
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec
import zstandard
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.opcode import Opcode

from s2r_runtime.files.durable import sync_folder
from s2r_runtime.recording.chain import GENESIS, advance, signed
from s2r_runtime.recording.channels import CHAIN, NUMBERS, Seal
from s2r_runtime.recording.layout import MESSAGE, MESSAGE_FIELDS, chunk, declaration
from s2r_runtime.recording.start import make_start
from s2r_runtime.recording.summary import tail

End = Literal["", "rotated", "closed"]
_CHAIN = NUMBERS[CHAIN]


class Pending:
    """What gathers between two seals: records outside the chunk, then the chunk's messages. The last one of a file has no messages.

    `seal_index`: the number reserved for its seal; `end`: whether the file ends with it; `held`: its bytes as accounted for.
    """

    __slots__ = ("content", "end", "held", "index", "opened_s", "prefix", "seal_index")

    def __init__(self) -> None:
        self.prefix: list[bytes] = []
        self.content = bytearray()
        self.index: dict[int, array[int]] = {}
        self.opened_s = time.monotonic()
        self.seal_index = 0
        self.held = 0
        self.end: End = ""

    def add(self, channel: int, number: int, t_ns: int, raw: bytes) -> None:
        """Takes a message in. number: its index in the run."""
        pairs = self.index.get(channel)
        if pairs is None:
            pairs = self.index[channel] = array("Q")
        pairs.append(t_ns)
        pairs.append(len(self.content))
        self.content += MESSAGE.pack(Opcode.MESSAGE, MESSAGE_FIELDS + len(raw), channel, number & 0xFFFFFFFF, t_ns, t_ns)
        self.content += raw

    def declare(self, preamble: bytes) -> None:
        """Puts schema and channel records before the messages."""
        self.content[:0] = preamble
        for pairs in self.index.values():
            pairs[1::2] = array("Q", [offset + len(preamble) for offset in pairs[1::2]])


class LogFile:
    """The parts of one run's log. about: what their first metadata record says beside the chain's own. Raises OSError."""

    def __init__(self, path: Path, run: str, signer: Ed25519PrivateKey | None, about: Mapping[str, str]) -> None:
        self.parts: list[Path] = []
        self.head = self._written = GENESIS
        self.anchor: tuple[bytes, int, int] = (GENESIS, 0, 0)
        """Head of the chain, part and messages as far as the disk is known to have them: whoever lacks these later has cut them off."""
        self.doubted = False
        """Whether a sync failed. The disk says so once, and the next may succeed without what was lost (fsync(2)): none counts any more."""
        self.recorded = 0
        """Messages of the run that are in the files and sealed."""
        self.size = self.chunks = 0
        self.opened_s = 0.0
        self._path, self._run, self._signer, self._about = path, run, signer, dict(about)
        self._fd = -1
        self._aside: deque[_Part] = deque()
        self._completing = threading.Lock()
        self._telling = threading.Lock()
        """Held from before a sync beside the others until it is noted how that went."""
        self._crc = self._sealed_ns = 0
        self._file = hashlib.sha256()
        self._seal = self._unwritten = b""
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._compressor = zstandard.ZstdCompressor(level=1)

    @property
    def is_open(self) -> bool:
        """Whether there is a part to write to."""
        return self._fd >= 0

    def open(self) -> bytes:
        """Makes the next part. Gives the bytes it begins with: they belong before the next block's records."""
        part = len(self.parts) + 1
        path = self._path if part == 1 else self._path.with_suffix(f".{part:03d}{self._path.suffix}")
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            sync_folder(path.parent)
        except OSError:
            os.close(fd)
            path.unlink()
            raise
        self._fd = fd
        self.parts.append(path)
        self.size = self._crc = self.chunks = 0
        self._file = hashlib.sha256()
        self.opened_s = time.monotonic()
        self._schemas, self._channels, self._seal = {}, {}, b""
        key = b"" if self._signer is None else self._signer.public_key().public_bytes_raw()
        return make_start(self._about, run=self._run, part=part, first_index=self.recorded, public_key=key, previous_head=self.head)

    def put(self, block: Pending) -> None:
        """Seals a block, once, and hands it to the operating system; after an error call again with the same one."""
        if not self._unwritten:
            self._unwritten = self._sealed(block)
        self._append(self._unwritten)
        self._crc = zlib.crc32(self._unwritten, self._crc)
        self._file.update(self._unwritten)
        self._unwritten = b""
        self.chunks += 1
        self.recorded, self._written = block.seal_index + 1, self.head

    def sync(self) -> None:
        """Returns once what was written is on the disk, in the parts that were set aside too. A sync that another thread has under way may
        be the one that is told of a failure: it is waited for.
        """
        try:
            for part in tuple(self._aside):
                part.sync()
            if self._fd >= 0:
                reached = self._reached()
                os.fsync(self._fd)
                with self._telling:
                    if self.doubted:
                        raise OSError(errno.EIO, os.strerror(errno.EIO))
                self.synced(reached)
        except OSError:
            self.doubted = True
            raise

    def sync_data(self, fd: int) -> None:
        """Syncs a descriptor that `unsynced` gave, beside whatever else is done."""
        with self._telling:
            try:
                os.fdatasync(fd)
            except OSError:
                self.doubted = True
                raise
            finally:
                os.close(fd)

    def unsynced(self) -> tuple[int, tuple[bytes, int, int]] | None:
        """A descriptor of its own, and how far the disk has the log once that is synced; None if the disk has all of it, or if a part that
        was set aside comes first: one file's sync says nothing of another's.
        """
        reached = self._reached()
        return None if self._aside or self._fd < 0 or reached == self.anchor else (os.dup(self._fd), reached)

    def synced(self, reached: tuple[bytes, int, int]) -> None:
        """The disk has the log so far, at least."""
        if reached[2] >= self.anchor[2] and not self.doubted:
            self.anchor = reached

    def all_synced(self) -> None:
        """Every part is whole, and on the disk."""
        with self._telling:
            self.synced(self._reached())

    def _reached(self) -> tuple[bytes, int, int]:
        return self._written, len(self.parts), self.recorded

    def set_aside(self) -> None:
        """The part holds all its data. What follows, an index that may take a second, is left to `complete`: the next part can begin."""
        self._aside.append(_Part(self._fd, self.size, self._crc, self._schemas, self._channels))
        self._fd = -1

    def complete(self) -> None:
        """Writes what follows the data of parts that were set aside, and closes them. After an error a file ends with its data."""
        with self._completing:
            while self._aside:
                part = self._aside[0]
                try:
                    part.complete()
                finally:
                    self.doubted = self.doubted or part.doubted
                self._aside.popleft()

    def abandon(self) -> None:
        """Closes everything as it is."""
        for part in self._aside:
            os.close(part.fd)
        self._aside.clear()
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1

    def _sealed(self, block: Pending) -> bytes:
        new = sorted(channel for channel in {*block.index, _CHAIN} if channel not in self._channels)
        for channel in new:
            self._schemas[channel], self._channels[channel] = declaration(channel)
        if new:
            block.declare(b"".join(self._schemas[channel] + self._channels[channel] for channel in new))
        first = next(iter(block.index.values()))[0] if block.index else self._sealed_ns
        last = max((pairs[-2] for pairs in block.index.values()), default=self._sealed_ns)
        head = advance(self.head, self._seal, [*block.prefix, block.content])
        seal = signed(Seal(last, block.seal_index, head, self._file.digest(), block.end), self._signer)
        start = len(block.content)
        block.add(_CHAIN, block.seal_index, last, msgspec.json.encode(seal))
        self.head, self._seal, self._sealed_ns = head, bytes(block.content[start:]), last
        compressor = None if block.end else self._compressor
        return b"".join([*block.prefix, chunk(bytes(block.content), block.index, first, last, compressor)])

    def _append(self, data: bytes) -> None:
        """All of it or nothing: after an error the file is cut back to where it was."""
        try:
            self.size = _write(self._fd, data, self.size)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size)
            raise


class _Part:
    """A part whose data are all there. `closed`: and it is whole, and on the disk. `doubted`: a sync failed."""

    def __init__(self, fd: int, end: int, crc: int, schemas: Mapping[int, bytes], channels: Mapping[int, bytes]) -> None:
        self.fd, self.closed, self.doubted = fd, False, False
        self._telling = threading.Lock()
        self._end, self._crc, self._schemas, self._channels = end, crc, schemas, channels

    def complete(self) -> None:
        """Writes what follows the data."""
        at = self._end
        try:
            for piece in tail(self._read_at, self._end, self._crc, self._schemas, self._channels):
                at = _write(self.fd, piece, at)
                time.sleep(0)  # the index of a long log takes a second: other threads get their turn
            with self._telling:
                self.doubted = True
                os.fsync(self.fd)
                self.doubted = False
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self.fd, self._end)
            raise
        self.closed = True
        os.close(self.fd)

    def sync(self) -> None:
        """Returns once the data are on the disk."""
        try:
            os.fsync(self.fd)
        except OSError:
            if not self.closed:  # by another thread, between two lines; then they are
                raise
        with self._telling:
            if self.doubted:
                raise OSError(errno.EIO, os.strerror(errno.EIO))

    def _read_at(self, length: int, offset: int) -> bytes:
        return os.pread(self.fd, length, offset)


def _write(fd: int, data: bytes, at: int) -> int:
    """Writes all of it; where it ends."""
    view = memoryview(data)
    while view:
        written = os.pwrite(fd, view, at)
        view, at = view[written:], at + written
    return at
