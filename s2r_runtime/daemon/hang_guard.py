"""Ends a call into somebody else's code that does not return.

A transport is called from the loop that runs the gate, so a call that hangs would hang the gate. It is met in three steps:

    limit          the call is interrupted: `Hung` is raised inside it. If it sleeps, waits for a socket or a lock, or runs in circles in
                   Python, it ends; whoever called goes on without that plug-in
    limit + GRACE  it did not end (a library's C code that waits on): one line says which call, and the process ends with exit code 70.
                   Nothing is sent any more, and the robot stops by its own time-out
    STUCK          nothing in Python runs, not even this guard (C code that waits and keeps the interpreter's lock): the kernel's timer,
                   which the guard else sets anew, ends the process by SIGALRM, and the stack on stderr says where it was

A look counts for LOOK_S however long ago the last one was: a machine that slept, or a process that was stopped for less than STUCK, has
not hung. The kernel's timer runs on in a stopped process, so one that is stopped (SIGSTOP) for longer ends when it goes on.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import NamedTuple, Self, TypeVar

Result = TypeVar("Result")

LOOK_S = 0.25
CALL_S = 2.0
"""For what must return at once: far beyond what a busy machine takes for it, and the longest that the gate can be held up."""
OPEN_S = 10.0
"""For making, opening and closing: libraries are imported, start and end their threads, read files, on a busy machine."""
GRACE_S = 2.0
STUCK_S = 15.0
"""Above OPEN_S + GRACE_S."""
KNOCK = signal.SIGUSR2
EXIT = 70


class Hung(BaseException):
    """Raised inside of a call that hung. Not an Exception: what hangs must not catch it by the way."""


class _Call(NamedTuple):
    number: int
    what: str
    limit_s: float


class HangGuard:
    """Use as a context manager in the main thread, which is the one that calls. say: takes a line for the journal, from another thread."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._call: _Call | None = None
        self._number = 0
        self._knocked = -1
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="hang-guard", daemon=True)
        self._main = threading.main_thread().ident
        self._timer = False

    def __enter__(self) -> Self:
        self._before = signal.signal(KNOCK, self._interrupt)
        free = signal.getsignal(signal.SIGALRM) is signal.SIG_DFL and signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
        if free:  # otherwise somebody else's timer runs in this process, and is left alone
            faulthandler.register(signal.SIGALRM, file=sys.__stderr__ or 2, all_threads=False, chain=True)
            signal.setitimer(signal.ITIMER_REAL, STUCK_S)
            self._timer = True
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        if self._timer:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            faulthandler.unregister(signal.SIGALRM)
        signal.signal(KNOCK, self._before)

    def call(self, what: str, limit_s: float, function: Callable[..., Result], *args: object) -> Result:
        """function(*args). Raises Hung if it does not return within limit_s, and whatever it raises."""
        self._number += 1
        self._call = _Call(self._number, what, limit_s)
        try:
            try:
                return function(*args)
            finally:
                self._call = None
        except Hung:  # it may have come just as the call returned
            self._call = None
            raise

    def _interrupt(self, _signal: int, _frame: object) -> None:
        call = self._call
        if call is not None and call.number == self._knocked:
            raise Hung(f"did not return within {call.limit_s:g} s")

    def _watch(self) -> None:
        looks, number = 0, -1
        while not self._ending.wait(LOOK_S):
            if self._timer:
                signal.setitimer(signal.ITIMER_REAL, STUCK_S)
            call = self._call
            if call is None or call.number != number:
                looks, number = 0, -1 if call is None else call.number
                continue
            looks += 1
            if looks * LOOK_S >= call.limit_s + GRACE_S:
                self._say(f"{call.what} hangs and cannot be interrupted: the daemon ends, nothing is sent any more")
                os._exit(EXIT)
            if looks * LOOK_S >= call.limit_s and self._knocked != number and self._main is not None:
                self._knocked = number
                signal.pthread_kill(self._main, KNOCK)
