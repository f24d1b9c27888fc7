"""A controller's answers, from a process of its own (`answering`): for verification, rehearsal, synthesis and driving alike.

    with BatchController(file, nu) as control:      starts it; the child confines itself and executes the file there
        u = control(x, theta)                       x (n, nx), theta: dict of arrays (n, ...) -> u (n, nu), finite

A controller that ran in the verifying process could change what is computed about it, or write the result itself. So the process that
verifies runs nothing of it, and takes nothing from the child but n * nu numbers for each question, or a text that ends it.

    parent -> child   8 bytes length, pickle of (x, theta); the numbers of their arrays lie in memory that both have, one after the other
    child -> parent   1 byte kind, 8 bytes length, content: u as float64, rows first; or why there is none (UTF-8)

The parent writes to that memory and never reads it. Its size is sealed.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import pickle
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.answering import ANSWER, DETAIL_MAX, LENGTH, MALFORMED, RAISED, READY, REFUSED, Start
from s2r_runtime.controllers.code import Malformed, Raised
from s2r_runtime.controllers.confined_process import environment, signal_name
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.errors import ControllerError, one_line
from s2r_runtime.hookspecs import Scenario

Array = NDArray[np.float64]

MEMORY_BYTES = 2 << 30
"""What a controller may allocate beyond its libraries: the same in verification and in driving, since it can see the limit."""
SHARED_BYTES = 256 << 20
"""Address space for a question's arrays; what is not written takes no memory. Larger questions go over the socket."""
_ALIGNED = 64
"""Bytes: a line of the processor's cache."""
_ERRORS: dict[bytes, type[ControllerError]] = {RAISED: Raised, MALFORMED: Malformed, REFUSED: ControllerError}
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL  # else the child could take the memory from under the parent


class Died(ControllerError):
    """Its process ended. how: in a few words."""

    def __init__(self, text: str, how: str) -> None:
        super().__init__(text)
        self.how = how


class BatchController:
    """One controller in one process. Use as a context manager; then call it. From the main thread, whose end is the child's.

    contained: what is in force there (`confinement.confine`).
    """

    def __init__(
        self, file: ControllerFile, nu: int, memory_bytes: int = MEMORY_BYTES, printed: int | None = None, within_s: float = 0.0
    ) -> None:
        """printed: a pipe for what it prints (default: it is thrown away). within_s: how long its start and each answer may take (0:
        somebody else sees to that). Raises ControllerError if the file can't be executed there, OSError if no process can be had.
        """
        self._within_s, self._until_s = within_s, time.monotonic() + within_s
        self._nu, self._path, self._ended = nu, file.path, ""
        self._socket, theirs = socket.socketpair()
        memory = os.memfd_create("questions", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(memory, SHARED_BYTES)
            fcntl.fcntl(memory, fcntl.F_ADD_SEALS, _SEALS)
            self._shared = mmap.mmap(memory, SHARED_BYTES)
            try:
                self._process = _started(theirs, printed)
            finally:
                theirs.close()  # else its end would not show
            self._pid = self._process.pid
            try:
                self._hand_over(msgspec.json.encode(Start(file, nu, memory_bytes, os.getpid())), memory)
                kind, content = self._receive(0)
                if kind != READY:
                    raise self._error(kind, content)
                self.contained = tuple(filter(None, content.decode("ascii", "replace").split(",")))
            except BaseException:
                self.close()
                raise
        finally:
            os.close(memory)

    @property
    def pid(self) -> int:
        """Its process id; 0 once it is gone."""
        return self._pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None) -> None:
        self.close()

    def __call__(self, x: Array, theta: Scenario) -> Array:
        """u (n, nu), finite. Raises ControllerError (Raised, Malformed) with why there is none."""
        if self._ended:
            raise ControllerError(self._ended)
        question = self._packed(x, dict(theta))
        self._until_s = time.monotonic() + self._within_s
        try:
            self._socket.sendall(LENGTH.pack(len(question)))
            self._socket.sendall(question)
        except OSError:
            raise self._gone() from None
        size = len(x) * self._nu * 8
        kind, content = self._receive(size)
        if kind != ANSWER:
            raise self._error(kind, content)
        if len(content) != size:
            raise Malformed(f"{Path(self._path).name}: its process answered {len(content)} bytes, must be {size}")
        u = np.frombuffer(content, dtype=np.float64).reshape(len(x), self._nu).copy()
        if not np.isfinite(u).all():  # the child looked; but that was the child
            raise Malformed(f"{Path(self._path).name}: its process answered numbers that are not finite")
        return u

    def fileno(self) -> int:
        """Of the socket to it: readable while nothing is asked, it ended or says what nobody asked for."""
        return self._socket.fileno()

    def spoke_unasked(self) -> NoReturn:
        """Ends it, for that. Raises ControllerError."""
        try:
            hung_up = not self._socket.recv(1, socket.MSG_PEEK)
        except OSError:
            hung_up = True
        if hung_up:
            raise self._gone()
        self._end()
        self._ended = f"{Path(self._path).name}: its process sent what nobody asked for"
        raise Malformed(self._ended)

    def close(self) -> None:
        """Kills the process. May be called twice."""
        self._socket.close()
        self._end()
        self._shared.close()

    def _hand_over(self, start: bytes, memory: int) -> None:
        try:
            socket.send_fds(self._socket, [LENGTH.pack(len(start))], [memory])
            self._socket.sendall(start)
        except OSError:
            raise self._gone() from None

    def _packed(self, x: Array, theta: dict[str, Any]) -> bytes:
        buffers: list[pickle.PickleBuffer] = []
        theta = {name: _contiguous(value) for name, value in theta.items()}  # one form, whatever they were cut out of
        packed = pickle.dumps((_contiguous(x), theta), protocol=5, buffer_callback=buffers.append)
        spans, end = [], 0
        for buffer in buffers:
            data = buffer.raw()
            begin = -(-end // _ALIGNED) * _ALIGNED
            end = begin + data.nbytes
            if end > SHARED_BYTES:
                return pickle.dumps((pickle.dumps((x, theta), protocol=5), []))
            self._shared[begin:end] = data
            spans.append((begin, end))
        return pickle.dumps((packed, spans))

    def _end(self) -> int:
        """Kills it, if it still is; its return code, negative for a signal."""
        if self._pid:
            self._process.kill()
            self._pid = 0
        return self._process.wait()

    def _receive(self, size: int) -> tuple[bytes, bytes]:
        """The child's next message, of no more content than was asked for, or than a text may have."""
        kind = self._exactly(1)
        (length,) = LENGTH.unpack(self._exactly(LENGTH.size))
        if length > max(size, 4 * DETAIL_MAX):
            self._ended = f"{Path(self._path).name}: its process announced {length} bytes, at most {size} were asked for"
            self._end()
            raise Malformed(self._ended)
        return kind, self._exactly(length)

    def _exactly(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            try:
                if self._within_s:
                    self._socket.settimeout(max(self._until_s - time.monotonic(), 1e-3))
                part = self._socket.recv(min(size - len(data), 1 << 20))
            except TimeoutError:
                self._end()
                self._ended = f"{Path(self._path).name}: its process gave no answer within {self._within_s:g} s"
                raise ControllerError(self._ended) from None
            except OSError:
                part = b""
            if not part:
                raise self._gone()
            data += part
        return bytes(data)

    def _gone(self) -> ControllerError:
        """It hung up. Whether it also ended is seen to."""
        code = self._end()
        how = f"killed by {signal_name(-code)}" if code < 0 else f"exited with status {code}"
        self._ended = f"{Path(self._path).name}: its process died in the middle of a question ({how})"
        return Died(self._ended, how)

    def _error(self, kind: bytes, content: bytes) -> ControllerError:
        return _ERRORS.get(kind, Malformed)(one_line(content.decode("utf-8", "replace"), DETAIL_MAX))


def _started(channel: socket.socket, printed: int | None) -> subprocess.Popen[bytes]:
    """The process, with nothing of this one's but what it is given."""
    sink = printed
    if sink is None:
        reading, sink = os.pipe()
        threading.Thread(target=_drain, args=(reading,), name="printed", daemon=True).start()
    try:
        # -P: nothing is imported from where this happens to run; -u: what it printed is here when it is killed
        argv = [sys.executable, "-P", "-B", "-u", "-m", "s2r_runtime.controllers.answering"]
        return subprocess.Popen(argv, stdin=channel.fileno(), stdout=sink, stderr=sink, cwd="/", env=environment())
    finally:
        if printed is None:
            os.close(sink)


def _drain(reading: int) -> None:
    """Takes what it prints, so that printing doesn't block it."""
    while os.read(reading, 1 << 16):
        pass
    os.close(reading)


def _contiguous(value: Any) -> Any:
    if not isinstance(value, np.ndarray) or value.flags.c_contiguous or value.flags.f_contiguous:
        return value
    return np.ascontiguousarray(value)
