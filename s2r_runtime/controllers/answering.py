"""The controller's process, wherever it is asked: `python -P -B -u -m s2r_runtime.controllers.answering`, started by `batches`.

Verification, rehearsal, driving and re-asking all start this, with the same command line, environment, folder, descriptors, limits and
modules, and the same messages in the same form. So a controller can tell what it is asked for only by what it is asked (how many rows,
and which) and by when. `tests/test_examined.py` compares all that; the threat model lists what differs where the kernel lacks seccomp or
Landlock.

    descriptors   0 nothing, 1 and 2 a pipe for what it prints, 3 the socket, 4 the memory for arrays
    parent        one descriptor (the memory for arrays) with 8 bytes length, Start as JSON; then questions, see `batches`
    child         READY with what is in force (`confinement.confine`); then answers
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import mmap
import os
import pickle
import socket
import struct
import sys
from typing import Any

import msgspec
import numpy as np

from s2r_runtime.child import die_with_parent
from s2r_runtime.controllers.code import Array, Malformed, Raised, batch_control
from s2r_runtime.controllers.confinement import confine
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.errors import S2RError, one_line

DETAIL_MAX = 400
"""Characters of the child's account that are passed on."""
LENGTH = struct.Struct("<Q")
ANSWER, RAISED, MALFORMED, REFUSED, READY = b"u", b"r", b"m", b"x", b"k"
CHANNEL = 3


class Start(msgspec.Struct, frozen=True):
    """What is to run. parent: process that it ends with."""

    file: ControllerFile
    nu: int
    memory_bytes: int
    parent: int


def main() -> int:
    """The process's life. Returns the exit code."""
    channel, shared, start = _taken()
    try:
        die_with_parent(start.parent)
        faulthandler.enable()
        contained = confine(start.memory_bytes)
        _serve(channel, shared, start, contained)
    except BaseException as error:  # noqa: BLE001 - also SystemExit and KeyboardInterrupt are reasons
        with contextlib.suppress(BaseException):
            _send_error(channel, error)
    return 0


def _taken() -> tuple[socket.socket, mmap.mmap, Start]:
    """What the parent hands over; nothing else stays open."""
    os.dup2(0, CHANNEL, inheritable=False)
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, 0)
    os.closerange(CHANNEL + 1, max(nowhere, 64) + 1)
    channel = socket.socket(fileno=CHANNEL)
    head, descriptors, _, _ = socket.recv_fds(channel, LENGTH.size, 1)
    shared = mmap.mmap(descriptors[0], os.fstat(descriptors[0]).st_size)
    os.close(descriptors[0])
    (length,) = LENGTH.unpack(head)
    data = bytearray()
    while len(data) < length and (part := channel.recv(length - len(data))):
        data += part
    return channel, shared, msgspec.json.decode(bytes(data), type=Start)


def _serve(channel: socket.socket, shared: mmap.mmap, start: Start, contained: tuple[str, ...]) -> None:
    """Executes the file, then answers until the parent hangs up."""
    control = batch_control(start.file, start.nu)
    gc.collect()
    gc.freeze()  # what is there now stays; collections while driving have little to look at
    _send(channel, READY, ",".join(contained).encode())
    with channel.makefile("rb") as stream:
        while length := stream.read(LENGTH.size):
            x, theta = _question(stream.read(LENGTH.unpack(length)[0]), shared)
            try:
                answer = np.ascontiguousarray(control(x, theta)).tobytes()
            except (Raised, Malformed) as error:  # in other states it may know better
                _send_error(channel, error)
            else:
                _send(channel, ANSWER, answer)


def _question(data: bytes, shared: mmap.mmap) -> tuple[Array, dict[str, Any]]:
    """theta's arrays are views of the shared memory, valid until the next question; x is this process's own."""
    packed, spans = pickle.loads(data)  # noqa: S301 - the parent's, which is trusted
    view = memoryview(shared)
    x, theta = pickle.loads(packed, buffers=[view[begin:end] for begin, end in spans])  # noqa: S301 - likewise
    return x.copy(order="K"), theta


def _send_error(channel: socket.socket, error: BaseException) -> None:
    kind = MALFORMED if isinstance(error, Malformed) else RAISED if isinstance(error, Raised) else REFUSED
    text = str(error) if isinstance(error, S2RError) else f"{type(error).__name__}: {error}"
    _send(channel, kind, one_line(text, DETAIL_MAX).encode())


def _send(channel: socket.socket, kind: bytes, content: bytes) -> None:
    channel.sendall(kind + LENGTH.pack(len(content)) + content)


if __name__ == "__main__":
    sys.exit(main())
