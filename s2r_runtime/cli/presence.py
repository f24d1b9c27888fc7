"""Whether the person who gave a command is still there: Ctrl-C, a terminal that closes, `ssh` that drops, a reader that is gone.

Signals are noted, not raised, so that the command can still say what became of the robot. One that is ignored (`nohup`) stays ignored.
stdout and stderr count as soon as nobody can read them any more; stdin where it is a terminal or a socket (`ssh` without a terminal),
because the end of a pipe or a file on stdin means nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import stat
import sys
import threading

SIGNALS = {
    signal.SIGINT: "Ctrl-C (SIGINT)",
    signal.SIGTERM: "SIGTERM",
    signal.SIGHUP: "its terminal closed (SIGHUP)",
    signal.SIGQUIT: "SIGQUIT",
    signal.SIGTSTP: "Ctrl-Z (SIGTSTP)",
}
"""Ctrl-Z too: a command that stands still watches no robot."""
_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


class Presence:
    """Use as a context manager. `left`: why the person is not there any more, or empty; `exit_code`: what the command then ends with.

    signals: whether signals are listened for (only in the main thread; a second one ends the command at once).
    """

    def __init__(self, *, signals: bool = True) -> None:
        self.left, self.exit_code = "", 0
        self._listens = signals and threading.current_thread() is threading.main_thread()
        self._streams = select.poll()
        self._names: dict[int, str] = {}

    def __enter__(self) -> Presence:
        self._reading, self._writing = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._before = {}
        if self._listens:
            heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._came) for number in heard}
        self._watch_streams()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._writing)
        os.close(self._reading)

    def wait(self, sock: socket.socket) -> None:
        """Returns when the socket can be read, or the person left. Raises TimeoutError after the socket's own timeout."""
        timeout_s = sock.gettimeout()
        for descriptor in (sock.fileno(), self._reading):
            self._streams.register(descriptor, select.POLLIN)
        ready = self._streams.poll(None if timeout_s is None else round(1e3 * timeout_s))
        self._streams.unregister(sock.fileno())
        self._note(ready)
        if not ready and not self.left:
            raise TimeoutError

    def look(self) -> str:
        """Why the person is not there any more, or empty; returns at once."""
        if not self.left:
            self._note(self._streams.poll(0))
        return self.left

    def _watch_streams(self) -> None:
        for name, stream in (("stdin", sys.stdin), ("stdout", sys.stdout), ("stderr", sys.stderr)):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, or no file: nobody was there from the beginning
                descriptor = stream.fileno()
                kind = os.fstat(descriptor).st_mode
                if name != "stdin" or os.isatty(descriptor) or stat.S_ISSOCK(kind):
                    self._streams.register(descriptor, 0)
                    self._names[descriptor] = name

    def _note(self, ready: list[tuple[int, int]]) -> None:
        for descriptor, events in ready:
            if descriptor in self._names and events & _GONE and not self.left:
                self._leave(f"nobody is at its {self._names[descriptor]} any more", signal.SIGHUP)

    def _came(self, number: int, _frame: object) -> None:
        for other in self._before:
            signal.signal(other, signal.SIG_DFL)
        self._leave(SIGNALS[signal.Signals(number)], number)
        with contextlib.suppress(OSError):
            os.write(self._writing, b"!")

    def _leave(self, why: str, number: int) -> None:
        self.left, self.exit_code = why, 128 + number
