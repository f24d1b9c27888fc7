"""A controller's answers to whole batches, from a process of its own: for verification and synthesis, which must not believe it either.

    with BatchController(file, nu) as control:      forks; the child confines itself and executes the file there
        u = control(x, theta)                       x (n, nx), theta: dict of arrays (n, ...) -> u (n, nu), finite

A controller that ran in the verifying process could change what is computed about it, or write the result itself. So the process that
verifies runs nothing of it, and takes nothing from the child but n * nu numbers for each question, or a text that ends it.

    parent -> child   8 bytes length, pickle of (x, theta); the numbers of their arrays lie in memory that both have, one after the other
    child -> parent   1 byte kind, 8 bytes length, content: u as float64, rows first; or why there is none (UTF-8)

The parent writes to that memory and never reads it.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import pickle
import resource
import signal
import socket
import struct
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.child import die_with_parent
from s2r_runtime.controllers.code import Malformed, Raised, batch_control
from s2r_runtime.controllers.confinement import confine
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.errors import ControllerError, S2RError, one_line
from s2r_runtime.hookspecs import Scenario

Array = NDArray[np.float64]

DETAIL_MAX = 400
"""Characters of the child's account that are passed on."""
SHARED_BYTES = 256 << 20
"""Address space for a question's arrays; what is not written takes no memory. Larger questions go over the socket."""
_ALIGNED = 64
"""Bytes: a line of the processor's cache."""
_LENGTH = struct.Struct("<Q")
_ANSWER, _RAISED, _MALFORMED, _REFUSED, _READY = b"u", b"r", b"m", b"x", b"k"
_ERRORS: dict[bytes, type[ControllerError]] = {_RAISED: Raised, _MALFORMED: Malformed, _REFUSED: ControllerError}


class BatchController:
    """One controller in one forked process. Use as a context manager; then call it. From a process of one thread, or the fork may hang."""

    def __init__(self, file: ControllerFile, nu: int, memory_bytes: int) -> None:
        """Raises ControllerError if the file can't be executed there, OSError if there is no process to be had."""
        self._nu, self._path, self._ended = nu, file.path, ""
        self._socket, theirs = socket.socketpair()
        self._shared = mmap.mmap(-1, SHARED_BYTES)
        parent = os.getpid()
        self._pid = os.fork()
        if self._pid == 0:
            self._socket.close()
            _live(theirs, self._shared, parent, file, nu, memory_bytes)
        theirs.close()
        try:
            kind, content = self._receive(0)
            if kind != _READY:
                raise self._error(kind, content)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None) -> None:
        self.close()

    def __call__(self, x: Array, theta: Scenario) -> Array:
        """u (n, nu), finite. Raises ControllerError (Raised, Malformed) with why there is none."""
        if self._ended:
            raise ControllerError(self._ended)
        question = self._packed(x, dict(theta))
        try:
            self._socket.sendall(_LENGTH.pack(len(question)))
            self._socket.sendall(question)
        except OSError:
            raise self._gone() from None
        size = len(x) * self._nu * 8
        kind, content = self._receive(size)
        if kind != _ANSWER:
            raise self._error(kind, content)
        if len(content) != size:
            raise Malformed(f"{Path(self._path).name}: its process answered {len(content)} bytes, must be {size}")
        u = np.frombuffer(content, dtype=np.float64).reshape(len(x), self._nu).copy()
        if not np.isfinite(u).all():  # the child looked; but that was the child
            raise Malformed(f"{Path(self._path).name}: its process answered numbers that are not finite")
        return u

    def close(self) -> None:
        """Kills the process. May be called twice."""
        self._socket.close()
        self._end()
        self._shared.close()

    def _packed(self, x: Array, theta: dict[str, Any]) -> bytes:
        buffers: list[pickle.PickleBuffer] = []
        packed = pickle.dumps((x, theta), protocol=5, buffer_callback=buffers.append)
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
        """Kills it, if it still is; its wait status."""
        if not self._pid:
            return 0
        os.kill(self._pid, signal.SIGKILL)  # not waited for yet, so the number is still its own
        status = os.waitpid(self._pid, 0)[1]
        self._pid = 0
        return status

    def _receive(self, size: int) -> tuple[bytes, bytes]:
        """The child's next message, of no more content than was asked for, or than a text may have."""
        kind = self._exactly(1)
        (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size))
        if length > max(size, 4 * DETAIL_MAX):
            self._ended = f"{Path(self._path).name}: its process announced {length} bytes, at most {size} were asked for"
            self._end()
            raise Malformed(self._ended)
        return kind, self._exactly(length)

    def _exactly(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            try:
                part = self._socket.recv(min(size - len(data), 1 << 20))
            except OSError:
                part = b""
            if not part:
                raise self._gone()
            data += part
        return bytes(data)

    def _gone(self) -> ControllerError:
        """It hung up. Whether it also ended is seen to."""
        status = self._end()
        how = f"killed by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit status {os.waitstatus_to_exitcode(status)}"
        self._ended = f"{Path(self._path).name}: its process died in the middle of a question ({how})"
        return ControllerError(self._ended)

    def _error(self, kind: bytes, content: bytes) -> ControllerError:
        return _ERRORS.get(kind, Malformed)(one_line(content.decode("utf-8", "replace"), DETAIL_MAX))


# ---------------------------------------------------------------- in the child


def _live(channel: socket.socket, shared: mmap.mmap, parent: int, file: ControllerFile, nu: int, memory_bytes: int) -> NoReturn:
    """The child's whole life: never returns into what the parent was doing."""
    try:
        _leave_everything(channel, parent)
        confine(memory_bytes)
        _answer(channel, shared, file, nu)
    except BaseException as error:  # noqa: BLE001 - also SystemExit and KeyboardInterrupt must not go up into the parent's frames
        with contextlib.suppress(BaseException):
            _send_error(channel, error)
    finally:
        os._exit(0)


def _leave_everything(channel: socket.socket, parent: int) -> None:
    """No descriptor but the channel, no environment, no folder, no group of the parent's; it ends with the parent."""
    die_with_parent(parent)
    os.setsid()
    os.chdir("/")
    ctypes.CDLL(None).clearenv()
    os.environ.clear()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    keep = channel.fileno()
    os.closerange(3, keep)
    os.closerange(keep + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[0])


def _answer(channel: socket.socket, shared: mmap.mmap, file: ControllerFile, nu: int) -> None:
    """Executes the file, then answers until the parent hangs up."""
    control = batch_control(file, nu)
    _send(channel, _READY, b"")
    with channel.makefile("rb") as stream:
        while length := stream.read(_LENGTH.size):
            x, theta = _question(stream.read(_LENGTH.unpack(length)[0]), shared)
            try:
                answer = np.ascontiguousarray(control(x, theta)).tobytes()
            except (Raised, Malformed) as error:  # in other states it may know better
                _send_error(channel, error)
            else:
                _send(channel, _ANSWER, answer)


def _question(data: bytes, shared: mmap.mmap) -> tuple[Array, dict[str, Any]]:
    """theta's arrays are views of the shared memory, valid until the next question; x is this process's own."""
    packed, spans = pickle.loads(data)  # noqa: S301 - the parent's, which this process was a moment ago
    view = memoryview(shared)
    x, theta = pickle.loads(packed, buffers=[view[begin:end] for begin, end in spans])  # noqa: S301 - likewise
    return x.copy(order="K"), theta


def _send_error(channel: socket.socket, error: BaseException) -> None:
    kind = _MALFORMED if isinstance(error, Malformed) else _RAISED if isinstance(error, Raised) else _REFUSED
    text = str(error) if isinstance(error, S2RError) else f"{type(error).__name__}: {error}"
    _send(channel, kind, one_line(text, DETAIL_MAX).encode())


def _send(channel: socket.socket, kind: bytes, content: bytes) -> None:
    channel.sendall(kind + _LENGTH.pack(len(content)) + content)
