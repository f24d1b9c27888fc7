"""The recorder: a log written by a thread of its own, so that a slow disk holds up nobody.

`put` encodes the message and returns (about 3 µs); the thread seals, compresses and writes every `chunk_s`. A write may have to wait for
a sync that is under way (a file system that commits the file's length lets nobody change it), so after a slow sync the next one rests for
as long. A log has no holes: a
message that cannot be taken, because memory is full or it cannot be encoded, is the end of the log. It and all that come
after it are counted, the recorder's health stays bad until a new one is made, and the log says how many it lacks. A disk that is
full for a while is no end: what is in memory is written when there is room. A sync that fails is one: the system says so once, and the next
sync succeeds without what was lost.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from s2r_runtime.messages import LogHead, Struct
from s2r_runtime.recording.channels import Unrecorded
from s2r_runtime.recording.writer import Writer

LIMIT_BYTES = 16 << 20
"""Memory for what the disk has not taken: at 100 Hz about a minute and a half."""
RETRY_S = 0.2
"""After a failed write."""
DELAY_S = 0.5
"""Default of `recording.max_delay`: ten times the chunk's time. What a kill costs at most while the health is good."""
SYNC_S = 0.05
"""Between two syncs, by a thread of their own: with a chunk's time what a power cut may take, where nothing asked for more."""
REST_S = 1.0
"""The longest rest between two syncs, after one that took as long: it bounds what the rest adds to the loss of a power cut."""


class Health(NamedTuple):
    """`ok` iff every message so far is in the file or about to be. `unrecorded`: how many never will. `late`: it is not ok only because
    the disk is slow.
    """

    ok: bool
    detail: str
    unrecorded: int
    pending_bytes: int
    recorded: int
    late: bool = False


class Recorder:
    """Owns a `Writer` made with `timed=False`. limit_bytes: what may wait in memory. block_s: how long `put` may wait for
    room (lockstep, where the robot waits too); 0: it never waits. sync_s: between two syncs. max_delay_s: a message that waits for the
    disk for longer makes the health bad, until it is written. clock: s, of that wait.
    """

    def __init__(
        self,
        writer: Writer,
        *,
        limit_bytes: int = LIMIT_BYTES,
        block_s: float = 0.0,
        sync_s: float = SYNC_S,
        max_delay_s: float = DELAY_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._writer, self._sync_s, self._max_delay_s, self._clock = writer, sync_s, max_delay_s, clock
        writer.deferring = True
        self._limit_bytes, self._block_s = limit_bytes, block_s
        self._wake = threading.Event()
        self._room = threading.Condition()
        self._lock = threading.Lock()
        self._fault = ""
        self._trouble = self._sync_trouble = ""
        self._unrecorded = 0
        self._last_ns = 0
        self._written_s, self._written_awake_s = time.monotonic(), clock()
        self._requested = self._granted = self._writes = 0
        self._ending = self._over = False
        self._head = ""
        self._stop_syncing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        threading.Thread(target=self._keep_synced, name="log-sync", daemon=True).start()

    # ---- the gate's thread: nothing here waits for the disk, but `durable`, `settled` and `close`

    def put(self, message: Struct, t_ns: int) -> bool:
        """Records a message, in the order of the calls. False: it is not recorded, and the log ends before it."""
        if self._fault or self._writer.pending_bytes > self._limit_bytes:
            return self._squeeze(message, t_ns)
        return self._take(message, t_ns)

    def attach(self, name: str, media_type: str, data: bytes) -> bool:
        """Puts a file into the log, in the order of the calls. False: as for `put`."""
        if self._fault:
            return False
        self._writer.attach(name, media_type, data)
        return True

    def durable(self, timeout_s: float = 5.0) -> bool:
        """Waits until all that was put so far is on the disk (fsync). False: it is not, or not within the time."""
        with self._room:
            self._requested += 1
            ticket = self._requested
            self._wake.set()
            self._room.wait_for(lambda: self._granted >= ticket or self._over, timeout_s)
            return self._granted >= ticket and not self._fault

    def settled(self, timeout_s: float = 5.0) -> bool:
        """Waits until all that was put so far is on the disk by the writes and syncs that come anyway: as `durable`, but nothing is done
        for it, so that nothing is held up by it. False: it is not, or not within the time.
        """
        until = time.monotonic() + timeout_s
        with self._room:
            second = self._writes + 2  # the next one may have begun before
            self._room.wait_for(lambda: self._writes >= second or self._over, timeout_s)
            written = self._writes >= second
        there = self._writer.recorded
        while written and not self._over and self._writer.anchor.records < there and time.monotonic() < until:
            time.sleep(min(self._sync_s, SYNC_S))
        return written and self._writer.anchor.records >= there and not self._fault

    def health(self) -> Health:
        """How it is; never waits."""
        pending = self._writer.pending_bytes
        detail = self._fault or self._trouble or self._sync_trouble
        if not detail and not self._thread.is_alive() and not self._ending:
            detail = "the recorder's thread is dead"
        slow = False
        if not detail and pending and (late := self._clock() - self._written_awake_s) > self._max_delay_s:
            slow, detail = True, f"nothing reached the disk for {late:.1f} s (recording.max_delay is {self._max_delay_s:g} s)"
        return Health(not detail, detail, self._unrecorded, pending, self._writer.recorded, slow)

    @property
    def delay_s(self) -> float:
        """An upper bound on the time for which the oldest message has waited for the disk, s; 0: none waits."""
        return time.monotonic() - self._written_s if self._writer.pending_bytes else 0.0

    def caught_up(self, delay_s: float, timeout_s: float) -> bool:
        """Waits until no message has waited for longer than delay_s. False: not within the time, or the log is at its end."""
        with self._room:
            return self._room.wait_for(lambda: self.delay_s <= delay_s or self._over, timeout_s) and not self._over

    @property
    def head(self) -> str:
        """Head of the chain, in hex; the last one once closed."""
        return self._head or self._writer.head

    @property
    def anchor(self) -> LogHead:
        """Head of the chain as far as the disk has it."""
        return self._writer.anchor

    def close(self, timeout_s: float = 10.0) -> Health:
        """Writes what is there, seals the log for good, and ends the thread. Not ok: what was not recorded, and why."""
        self._ending = True
        self._wake.set()
        self._thread.join(timeout_s)
        health = self.health()
        if not self._head and health.ok:
            return health._replace(ok=False, detail=f"the log could not be closed within {timeout_s} s")
        return health

    def _take(self, message: Struct, t_ns: int) -> bool:
        try:
            self._writer.write(message, t_ns)
        except ValueError as error:
            return self._lost(f"a message cannot be recorded: {error}")
        self._last_ns = t_ns
        if self._writer.full_blocks:
            self._wake.set()
        return True

    def _squeeze(self, message: Struct, t_ns: int) -> bool:
        """There is no room: waits for some, as long as it may."""
        if self._fault:
            return self._lost(self._fault)
        if self._block_s:
            with self._room:
                self._wake.set()
                self._room.wait_for(lambda: self._writer.pending_bytes <= self._limit_bytes, self._block_s)
        if self._writer.pending_bytes > self._limit_bytes:
            return self._lost(self._trouble or "memory for the log is full: the disk is too slow")
        return self._take(message, t_ns)

    def _lost(self, reason: str) -> bool:
        with self._lock:
            self._fault = self._fault or reason
            self._unrecorded += 1
        return False

    # ---- its own thread

    def _run(self) -> None:
        try:
            while not self._ending:
                since_s = time.monotonic() - self._written_s
                self._wake.wait(RETRY_S if self._trouble else max(0.0, self._writer.chunk_s - since_s))
                self._wake.clear()
                self._write()
            self._finish()
        except BaseException as error:  # noqa: BLE001 - whatever ends the thread must be seen as bad health, not as a trace on stderr
            self._fault = self._fault or f"the recorder's thread died: {type(error).__name__}: {error}"
        finally:
            self._stop_syncing.set()
            with self._room:
                self._over = True
                self._room.notify_all()

    def _keep_synced(self) -> None:
        """The other thread. What it cannot sync is bad health, until it can: the log is then not what it promises after a power cut."""
        rest_s = self._sync_s
        while not self._stop_syncing.wait(RETRY_S if self._sync_trouble else rest_s):
            began_s = time.monotonic()
            try:
                self._writer.sync()
                rest_s = max(self._sync_s, min(time.monotonic() - began_s, REST_S))
                self._sync_trouble = ""
            except OSError as error:
                self._sync_trouble = f"the log cannot be synced: {error.strerror}"
                self._doubt()

    def _write(self) -> None:
        with self._room:
            ticket = self._requested
        began_s, began_awake_s = time.monotonic(), self._clock()  # what is put while this is written waits from here on
        try:
            if ticket > self._granted:
                self._writer.durable()
            else:
                self._writer.flush()
        except OSError as error:
            self._trouble = f"the log cannot be written: {error.strerror}"
            self._doubt()
            return
        self._trouble = ""
        self._written_s, self._written_awake_s = began_s, began_awake_s
        with self._room:
            self._granted, self._writes = ticket, self._writes + 1
            self._room.notify_all()

    def _doubt(self) -> None:
        """After a failure. One of a sync ends this log: that the next sync succeeds would not mean that the disk has it all."""
        if self._writer.doubted:
            with self._lock:
                self._fault = self._fault or "a sync of the log failed: nobody knows what the disk has of it"

    def _finish(self) -> None:
        """Last words and the final seal; tries again for as long as `close` waits, which is for the caller to bound."""
        if self._unrecorded:
            with contextlib.suppress(ValueError):
                self._writer.write(Unrecorded(self._last_ns, self._unrecorded, self._fault), self._last_ns)
        while True:
            try:
                self._head = self._writer.close()
                return
            except OSError as error:
                self._trouble = f"the log cannot be written: {error.strerror}"
                time.sleep(RETRY_S)
