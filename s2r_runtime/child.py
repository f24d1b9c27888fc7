"""A child process that speaks JSON lines over its stdin and stdout: how the daemon reaches its analytics and its workers.

Nothing here ever blocks the daemon's loop but `wait`, which has a deadline. What the child doesn't take at once is kept, up to a
bound; a child that leaves the bound behind, or sends an endless line, counts as dead.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence

PENDING_MAX = 64 << 20
"""Bytes kept for a child that is slow to read (a campaign of 10 000 samples is about 10 MB)."""
LINE_MAX = 64 << 20
PIPE_BYTES = 1 << 20
_PR_SET_PDEATHSIG = 1  # prctl(2)


class Child:
    """`python -m module PARENT_PID ...`, in a session of its own (a terminal's Ctrl-C is the daemon's to handle).

    Lines are bytes without their end.
    """

    def __init__(self, module: str, arguments: Sequence[str] = ()) -> None:
        # threads of BLAS cost memory, and the order of their sums repeatability
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, str(os.getpid()), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
            bufsize=0,
        )
        assert self._process.stdin is not None  # noqa: S101 - PIPE was asked for
        assert self._process.stdout is not None  # noqa: S101
        self._in, self._out = self._process.stdin, self._process.stdout
        for stream in (self._in, self._out):
            os.set_blocking(stream.fileno(), False)
        with contextlib.suppress(OSError, AttributeError):  # a bigger pipe saves turns of the loop; where there is none, it takes more
            fcntl.fcntl(self._in.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._pending = bytearray()
        self._read = bytearray()
        self._lines: list[bytes] = []
        self._ended = self._full = False

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def fileno(self) -> int:
        """Readable when `lines` has something, or the child is gone."""
        return self._out.fileno()

    def send(self, line: bytes) -> None:
        """Hands a line to the child; keeps what it doesn't take yet (see `retry`)."""
        self.queue(line)
        self.flush()

    def queue(self, line: bytes) -> None:
        """As `send`, together with the next line that is sent."""
        self._pending += line
        self._pending += b"\n"

    def retry(self) -> None:
        """Hands over what the child did not take earlier. Called now and then by the loop."""
        if self._full:
            self.flush()

    def flush(self) -> None:
        """Hands over everything, as far as the child takes it."""
        self._full = False
        while self._pending and not self._ended:
            try:
                written = os.write(self._in.fileno(), self._pending[:PIPE_BYTES])
            except BlockingIOError:
                self._full = True
                self._ended = len(self._pending) > PENDING_MAX
                return
            except OSError:  # it closed its end: it is gone, or going; what it said before can still be read
                self._pending.clear()
                return
            del self._pending[:written]

    def lines(self) -> list[bytes]:
        """What came since the last call, without blocking."""
        self._fill()
        found, self._lines = self._lines, []
        return found

    def wait(self, timeout_s: float) -> bytes | None:
        """The next line; None when the time is over or the child is gone."""
        deadline = time.monotonic() + timeout_s
        while True:
            if self._lines:
                return self._lines.pop(0)
            self.retry()
            left = deadline - time.monotonic()
            if self._ended or left <= 0.0:
                return None
            # 20 ms: what the pipe didn't take is offered again
            select.select([self._out], [], [], min(left, 0.02) if self._full else left)
            self._fill()

    def alive(self) -> bool:
        """Whether more can come from it."""
        return not self._ended

    def ending(self) -> str:
        """How it ended, in a few words."""
        if self._ended:  # the pipe's end comes a moment before the process's
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.05)
        code = self._process.poll()
        if code is None:
            return "no longer answers"
        return f"killed by signal {-code}" if code < 0 else f"exit code {code}"

    def signal(self, number: signal.Signals) -> None:
        """To the process and all that it started; one that is gone doesn't mind."""
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)

    def stop(self) -> None:
        """Kills it if it still runs, and frees everything; may be called twice."""
        self._ended = True
        for stream in (self._in, self._out):
            with contextlib.suppress(OSError):
                stream.close()
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _fill(self) -> None:
        while not self._ended:
            try:
                data = os.read(self._out.fileno(), 1 << 16)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data or len(self._read) > LINE_MAX:
                self._ended = True
                break
            self._read += data
        *complete, rest = self._read.split(b"\n") if self._read else [bytearray()]
        self._lines += [bytes(line) for line in complete]
        self._read = bytearray(rest)


def die_with_parent(parent_pid: int) -> None:
    """In a child: end when the daemon does, even one that was killed while this computes and reads nothing."""
    with contextlib.suppress(OSError, AttributeError):  # Linux only; elsewhere the closed pipe ends it at its next line
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        raise SystemExit(1)  # it died before the call


def stand_back(levels: int | None) -> None:
    """In a child of a daemon that has real-time priority, which it inherits: so many levels below it, or (None) none at all."""
    with contextlib.suppress(OSError, AttributeError):  # Linux only, and where the service manager lets it; it then stays beside the daemon
        policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        if policy not in (os.SCHED_FIFO, os.SCHED_RR):
            return
        if levels is None:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        else:
            os.sched_setscheduler(0, policy, os.sched_param(max(1, os.sched_getparam(0).sched_priority - levels)))


def take_stdout() -> int:
    """In a child: a descriptor for the lines to the daemon. What else is printed (a plug-in's debug output) goes to stderr."""
    channel = os.dup(1)
    os.dup2(2, 1)
    return channel


def say(channel: int, line: bytes) -> None:
    """In a child: a line to the daemon."""
    data = line + b"\n"
    while data:
        data = data[os.write(channel, data) :]
