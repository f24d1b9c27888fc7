"""Writes a log: MCAP, one file a run or several parts, every chunk sealed and handed to the operating system when it is closed.

A message becomes bytes in the caller's thread (about 2 µs); sealing, compressing and writing happen in `flush`, once a chunk,
mostly outside the interpreter's lock. So a thread of its own may call `flush` (`recorder`) while another one writes. After a
failed write the file is as it was, and the next `flush` tries the same bytes again: a full disk loses nothing as long as
memory holds it. The format: docs/log-format.md.
"""

from __future__ import annotations

import contextlib
import platform
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from importlib import metadata as packages
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.errors import RecordingError
from s2r_runtime.files.canonical import canonical
from s2r_runtime.messages import Frame, LogHead, Struct
from s2r_runtime.recording.channels import BY_TYPE, FRAME_IN, FRAME_OUT, NUMBERS
from s2r_runtime.recording.layout import MAX_CHUNK, attachment_record
from s2r_runtime.recording.logfile import End, LogFile, Pending
from s2r_runtime.recording.logs import Log, read_all
from s2r_runtime.recording.reading import Ending, Entry, Reading, read

CHUNK_S = 0.05
"""Half of the 100 ms that a kill may cost, so that a late wake-up of the thread still keeps the promise."""
CHUNK_BYTES = 1 << 20
"""A chunk of this size is closed at once: bounds memory at any message rate."""
PART_CHUNKS = 50_000
"""Chunks of a part at most (most of an hour): its index is made when it is closed, and that should take a second, not a minute."""
MAX_MESSAGE = MAX_CHUNK // 4
_FRAME_IN, _FRAME_OUT = NUMBERS[FRAME_IN], NUMBERS[FRAME_OUT]


def environment() -> dict[str, str]:
    """What ran: versions of interpreter and packages, platform, processor. Imports none of them."""
    found = {"python": platform.python_version(), "platform": platform.platform(), "byteorder": sys.byteorder, "cpu": _processor()}
    for name in ("s2r-runtime", "numpy", "scipy", "msgspec", "mcap", "zstandard", "cryptography"):
        with contextlib.suppress(packages.PackageNotFoundError):
            found[f"version.{name}"] = packages.version(name)
    return found


def _processor(info: Path = Path("/proc/cpuinfo")) -> str:
    """Its model: libraries choose their arithmetic by it, so last digits may depend on it. Empty if it isn't known."""
    with contextlib.suppress(OSError):
        for line in info.read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() in {"model name", "CPU part", "Model"} and value.strip():
                return value.strip()
    return platform.processor()


class Writer:
    """A log being written. Safe to use from several threads; the order of messages is the order of the calls.

    run: names this run and no other. signer: signs every seal; its public key is in the file. metadata: beside
    `environment()`. rotate_bytes, rotate_s: a new part begins when the file is that large or old (0: only after PART_CHUNKS);
    it continues the chain. timed: `write` itself closes a chunk that is old enough; switch it off where a thread calls
    `flush`. Raises RecordingError if the file exists or cannot be made.
    """

    def __init__(
        self,
        path: Path,
        *,
        run: str,
        signer: Ed25519PrivateKey | None = None,
        metadata: Mapping[str, str] | None = None,
        attachments: Iterable[tuple[str, str, bytes]] = (),
        chunk_s: float = CHUNK_S,
        rotate_bytes: int = 0,
        rotate_s: float = 0.0,
        timed: bool = True,
    ) -> None:
        self.path, self.chunk_s = path, chunk_s
        self._rotate_bytes, self._rotate_s, self._timed = rotate_bytes, rotate_s, timed
        self._encoder = msgspec.json.Encoder()
        self._adding = threading.Lock()
        self._writing = threading.RLock()
        self._block, self._waiting = Pending(), deque[Pending]()
        self._next = self._last_ns = self._held_bytes = 0
        self._ended: End = ""
        self._closing = False
        self.deferring = False
        """Whether `sync` writes the index of a part that is full, not `flush`: where `sync` has a thread of its own."""
        self._run, self._public_key = run, b"" if signer is None else signer.public_key().public_bytes_raw()
        self._file = LogFile(path, run, signer, {**environment(), **(metadata or {})})
        try:
            self._open()
        except OSError as error:
            raise RecordingError(f"{path}: the log cannot be created: {error.strerror}") from None
        for name, media_type, data in attachments:
            self.attach(name, media_type, data)

    # ---- any thread

    def write(self, message: Struct, t_ns: int) -> None:
        """Takes a message in. t_ns: log time; where it goes back it is raised to the last one, the message keeps its own.

        Raises ValueError for a number that is not finite (JSON has no word for it, so it could not be read back), for a
        message larger than MAX_MESSAGE, and after `close`; OSError where `flush` does.
        """
        kind = type(message)
        channel = (_FRAME_IN if message.inbound else _FRAME_OUT) if kind is Frame else BY_TYPE[kind]  # type: ignore[attr-defined]
        raw = self._encoder.encode(message)
        if b"null" in raw:
            canonical(message)
        if len(raw) > MAX_MESSAGE:
            raise ValueError(f"message {kind.__name__} has {len(raw)} bytes, must have at most {MAX_MESSAGE}")
        with self._adding:
            if self._closing:
                raise ValueError(f"{self.path}: the log is closed")
            self._last_ns = max(self._last_ns, t_ns)
            block = self._block
            block.add(channel, self._next, self._last_ns, raw)
            self._next += 1
            if len(block.content) >= CHUNK_BYTES:
                self._turn("")
        if self._timed and (self._waiting or time.monotonic() - block.opened_s >= self.chunk_s):
            self.flush()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Puts a file into the log, after all that was written so far."""
        with self._adding:
            if self._block.content:
                self._turn("")
            self._block.prefix.append(attachment_record(name, media_type, self._last_ns, data))

    @property
    def pending_bytes(self) -> int:
        """Bytes of messages taken in and not yet handed to the operating system."""
        return self._held_bytes + len(self._block.content)

    @property
    def full_blocks(self) -> int:
        """Blocks that wait to be written because they are full."""
        return len(self._waiting)

    @property
    def recorded(self) -> int:
        """Messages, seals among them, that a kill can no longer take."""
        return self._file.recorded

    @property
    def head(self) -> str:
        """Head of the chain after the last seal, in hex: print it, so that a missing tail shows."""
        return self._file.head.hex()

    @property
    def anchor(self) -> LogHead:
        """The newest head that is on the disk, whatever happens now: publish it, so that a missing tail shows."""
        head, part, records = self._file.anchor
        return LogHead(self._run, part, records, head.hex(), self._public_key.hex())

    @property
    def doubted(self) -> bool:
        """Whether a sync failed: from then on nobody knows what the disk has of this log."""
        return self._file.doubted

    @property
    def parts(self) -> list[Path]:
        """The files, in order."""
        return list(self._file.parts)

    # ---- one thread at a time

    def flush(self) -> None:
        """Seals all that was taken in and hands it to the operating system. Raises OSError; then nothing is lost, call again."""
        with self._writing:
            with self._adding:
                if self._block.content or self._block.prefix:
                    self._turn("")
            self._drain()
            if self._full():
                with self._adding:
                    self._turn_for_good("rotated")
                self._drain()

    def durable(self) -> None:
        """As `flush`, and returns once it is on the disk (fsync)."""
        with self._writing:
            self.flush()
            self._file.sync()

    def sync(self) -> None:
        """What was handed to the operating system goes to the disk. Seals nothing; the next chunk is written meanwhile."""
        self._file.complete()
        with self._writing:
            todo = self._file.unsynced()
        if todo is None:
            return
        fd, reached = todo
        self._file.sync_data(fd)
        with self._writing:
            self._file.synced(reached)

    def close(self) -> str:
        """Seals for good, writes the index, and returns the head. Raises OSError; then call again, or leave it as a cut file."""
        with self._writing:
            with self._adding:
                if not self._closing:
                    self._closing = True
                    self._turn_for_good("closed")
            self._drain()
            self._file.all_synced()
        return self.head

    def abandon(self) -> None:
        """Frees the file without another byte written."""
        with self._writing:
            self._closing = True
            self._waiting.clear()
            self._file.abandon()

    def _turn(self, end: End) -> None:
        """The current block is complete: what follows goes into the next. Holds `_adding`."""
        block = self._block
        block.seal_index, block.end, block.held = self._next, end, len(block.content)
        self._next += 1
        self._held_bytes += block.held
        self._waiting.append(block)
        self._block = Pending()

    def _turn_for_good(self, end: End) -> None:
        """As `_turn`, and the file ends with a block that holds its seal and nothing else."""
        if self._block.content or self._block.prefix:
            self._turn("")
        self._turn(end)

    def _drain(self) -> None:
        """Writes the blocks that wait; goes on where an error stopped it."""
        while True:
            if self._ended:
                if self._file.is_open:
                    self._file.set_aside()
                if self._closing or not self.deferring:
                    self._file.complete()
                self._ended = ""
            if not self._waiting and self._closing:
                return
            if not self._file.is_open:
                self._open()
            if not self._waiting:
                return
            block = self._waiting[0]
            self._file.put(block)
            self._waiting.popleft()
            with self._adding:
                self._held_bytes -= block.held
            self._ended = block.end

    def _open(self) -> None:
        """Begins a part: its first bytes go before the first block that waits."""
        start = self._file.open()
        with self._adding:
            first = self._waiting[0] if self._waiting else self._block
            first.prefix.insert(0, start)

    def _full(self) -> bool:
        file = self._file
        old = self._rotate_s and time.monotonic() - file.opened_s >= self._rotate_s
        return bool(old or file.chunks >= PART_CHUNKS or (self._rotate_bytes and file.size >= self._rotate_bytes))


__all__ = ["CHUNK_S", "Ending", "Entry", "Log", "Reading", "Writer", "environment", "read", "read_all"]
