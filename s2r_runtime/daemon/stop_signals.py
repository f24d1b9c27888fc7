"""SIGTERM, SIGINT and SIGHUP as something that a loop can wait for."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""SIGHUP: the terminal closed. Unhandled, it would end the daemon without its last command."""


class StopSignals:
    """`name`: of the signal that came, or empty. A signal that is ignored (`nohup`) stays ignored. The handler runs between two lines of
    anything, so all it does is to note the name and to write into a pipe, which wakes the loop. Use as a context manager, in the main
    thread.
    """

    def __init__(self, selector: selectors.BaseSelector) -> None:
        self.name = ""
        self._selector = selector

    def __enter__(self) -> StopSignals:
        self._reading, self._writing = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._selector.register(self._reading, selectors.EVENT_READ, lambda _: os.read(self._reading, 100))
        heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._came) for number in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._selector.unregister(self._reading)
        os.close(self._writing)
        os.close(self._reading)

    def _came(self, number: int, _frame: object) -> None:
        self.name = signal.Signals(number).name
        with contextlib.suppress(OSError):
            os.write(self._writing, b"!")
