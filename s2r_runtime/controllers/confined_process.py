"""A child process that is not trusted, seen from the daemon: a socket of lines, a pipe of what it prints, and its end.

Nothing here waits, what is read and kept is bounded, and killing it kills its whole process group. The child confines itself
(`confinement`); what stands here holds even if it doesn't.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import shutil
import signal
import site
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import ClassVar

from s2r_runtime.errors import one_line

LINE_MAX = 64 << 10
"""Bytes. A message has a few hundred; who sends more without an end of line sends no message."""
ENDS_WITHIN_S = 0.02
"""How long the daemon's loop waits to learn how a controller ended: it has commands to send."""
FOLDER = "s2r-controller-"
NEW_S = 60.0
"""A folder that is younger may be about to be locked."""
READ_MAX = 64 << 10
"""Bytes taken from the child at a time, from the socket and from the pipe: one that floods costs the loop no more than that."""
OUTPUT_KEPT = 4 << 10
"""Bytes of the last that it printed, for the reader."""


def remove_left_folders() -> None:
    """Folders of controllers whose daemon was killed: nobody holds their lock. Those of other users stay."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER}*"):
        with contextlib.suppress(OSError):
            number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                status = os.fstat(number)
                if status.st_uid == os.geteuid() and time.time() - status.st_mtime > NEW_S:
                    fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(number)


class ConfinedProcess:
    """`python -m module DESCRIPTOR PARENT_PID` in a session, a folder and an environment of its own. DESCRIPTOR: its end of the socket."""

    _dying: ClassVar[list[ConfinedProcess]] = []
    """Killed and closed, but not gone yet: freeing a gigabyte takes the kernel a while, and nobody waits for that."""

    def __init__(self, module: str) -> None:
        """Starts it. From the main thread: the child dies with the thread that made it. Raises OSError if that can't be."""
        self._dying[:] = [process for process in self._dying if not process.reap()]
        self._epoll = select.epoll()
        remove_left_folders()
        self._folder = Path(tempfile.mkdtemp(prefix=FOLDER))
        self._holding = os.open(self._folder, os.O_RDONLY | os.O_CLOEXEC)
        fcntl.flock(self._holding, fcntl.LOCK_EX)
        self._channel, theirs = socket.socketpair()
        self._printed, writing = os.pipe()
        try:
            self._process = subprocess.Popen(
                # -P: nothing is imported from where this happens to run; -u: what it printed is here when it is killed
                [sys.executable, "-P", "-B", "-u", "-m", module, str(theirs.fileno()), str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=writing,
                stderr=writing,
                pass_fds=(theirs.fileno(),),
                cwd=self._folder,
                env=environment(),
                start_new_session=True,
            )
        except BaseException:
            self._channel.close()
            os.close(self._printed)
            self._epoll.close()
            self._folder.rmdir()
            os.close(self._holding)
            raise
        finally:
            theirs.close()
            os.close(writing)
        self._channel.setblocking(False)
        os.set_blocking(self._printed, False)
        self._epoll.register(self._channel, select.EPOLLIN)
        self._epoll.register(self._printed, select.EPOLLIN)
        self._out, self._in, self._output = bytearray(), bytearray(), bytearray()
        self._writing = False

    def fileno(self) -> int:
        """Readable when there is something to receive, or room for what waits to be sent. Valid until `close`."""
        return self._epoll.fileno()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def output(self) -> str:
        """The last that it printed, on stdout and stderr."""
        return bytes(self._output).decode("utf-8", "replace")

    def send(self, line: bytes) -> None:
        """Hands over a line; what it doesn't take at once is kept for `receive` to go on with."""
        self._out += line
        self._out += b"\n"
        self._flush()

    def receive(self) -> tuple[list[bytes], bool]:
        """Complete lines since the last call, at most READ_MAX bytes of them; and whether more can come.

        A line without end counts as complete, for the reader to refuse.
        """
        self._flush()
        self._drain()
        if self._channel.fileno() < 0:
            return [], False
        try:
            data = self._channel.recv(READ_MAX)
        except BlockingIOError:
            return [], not self.dead()
        except OSError:
            data = b""
        self._in += data
        *lines, self._in = self._in.split(b"\n")
        if len(self._in) > LINE_MAX:
            lines, self._in = [*lines, self._in], bytearray()
        return [bytes(line) for line in lines], bool(data)

    def dead(self) -> bool:
        """Whether it ended. It stays a zombie until `kill` has reached its group, so that the group's number is nobody else's."""
        return self._process.returncode is not None or self._status() is not None

    def ending(self) -> str:
        """How it ended, in a few words. Waits up to ENDS_WITHIN_S: the end of its socket comes a moment before its own."""
        deadline = time.monotonic() + ENDS_WITHIN_S
        while (status := self._status()) is None and time.monotonic() < deadline:
            time.sleep(0.0005)
        how = "closed its socket"
        if status is not None:
            code = status.si_status
            how = f"exited with status {code}" if status.si_code == os.CLD_EXITED else f"killed by {signal_name(code)}"
        return how + self.last_printed()

    def last_printed(self) -> str:
        """`; it last printed: ...`, or empty."""
        self._drain()
        last = self.output.strip().splitlines()[-1:]
        return "".join(f"; it last printed: {one_line(line, 200)}" for line in last)

    def kill(self) -> None:
        """Ends it and all of its group, at once. May be called twice."""
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._drain()
        self._channel.close()  # which takes it out of the epoll, as below
        if self._printed >= 0:
            os.close(self._printed)
            self._printed = -1
        self.reap()

    def reap(self) -> bool:
        """After `kill`: frees what is left of it, once the kernel has ended it. Whether it has."""
        if self._process.poll() is None:
            return False
        shutil.rmtree(self._folder, ignore_errors=True)
        if self._holding >= 0:
            os.close(self._holding)
            self._holding = -1
        return True

    def close(self) -> None:
        """Kills it, waits a few milliseconds until it is gone, frees everything. May be called twice."""
        self.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.02)
        if not self.reap() and self not in self._dying:
            self._dying.append(self)
        self._epoll.close()

    def _status(self) -> os.waitid_result | None:
        if self._process.returncode is not None:
            return None
        return os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)

    def _flush(self) -> None:
        if self._channel.fileno() < 0:
            return
        while self._out:
            try:
                del self._out[: self._channel.send(self._out)]
            except BlockingIOError:
                break
            except OSError:  # it closed its end; `receive` will see that
                self._out.clear()
        if self._writing != bool(self._out):
            self._writing = bool(self._out)
            self._epoll.modify(self._channel, select.EPOLLIN | (select.EPOLLOUT if self._writing else 0))

    def _drain(self) -> None:
        """Takes what it printed, so that printing doesn't block it."""
        if self._printed < 0:
            return
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._printed, READ_MAX)
            self._output += data
            del self._output[:-OUTPUT_KEPT]
            if not data:
                os.close(self._printed)
                self._printed = -1


def environment() -> dict[str, str]:
    """A child's, whole: nothing of the daemon's. One thread for BLAS: more would take time from the gate."""
    return {
        "PATH": "/usr/local/bin:/usr/bin:/bin",
        "LANG": "C.UTF-8",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "PYTHONHASHSEED": "0",  # one order of sets in every run
        **({} if _in_user_site() else {"PYTHONNOUSERSITE": "1"}),  # where a `usercustomize` would run first, before it is confined
    }


def _in_user_site() -> bool:
    """Whether the runtime itself is installed in the user's own site-packages: then they are needed."""
    folder = site.getusersitepackages()
    return Path(__file__).is_relative_to(folder)


def signal_name(number: int) -> str:
    """`SIGKILL` for 9."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
