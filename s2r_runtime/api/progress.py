"""Progress and notes of long work, for whoever shows them: a function of the caller's, tqdm, or the command line."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

from s2r_runtime.errors import UsageError

QUIET_S = 2.0
"""Work that takes less shows nothing."""
EVERY_S = 0.1
"""Least time between two reports of one phase, s."""


class Step(NamedTuple):
    """How far a phase of the work is."""

    phase: str
    """`reading`, `tracing`, `verifying`, `auditing`, `sampling`, ..."""
    done: float
    total: float
    detail: str
    """What is being done, or empty."""
    seconds_left: float | None
    """Estimated from the pace so far; None while nothing is done."""


Callback = Callable[[Step], None]


class Report(Protocol):
    """What the work calls: done of total, and what is being done."""

    def __call__(self, done: float, total: float, detail: str = "", seconds_left: float | None = None) -> None:
        """seconds_left: where the work knows better than the pace so far."""


class Watcher:
    """Where progress and notes go; this one shows nothing."""

    @contextmanager
    def phase(self, what: str) -> Iterator[Report]:
        """A phase of the work begins; it ends with the block."""
        began = last = time.monotonic()

        def report(done: float, total: float, detail: str = "", seconds_left: float | None = None) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last < EVERY_S and done < total:
                return
            last = now
            if seconds_left is None and done > 0.0:
                seconds_left = (now - began) / done * max(total - done, 0.0)
            self.show(Step(what, float(done), float(total), detail, seconds_left), now - began)

        try:
            yield report
        finally:
            self.ended(what)

    def show(self, step: Step, seconds: float) -> None:
        """One report. seconds: since the phase began."""

    def ended(self, phase: str) -> None:
        """A phase ended, well or not."""

    def notes(self, source: str, lines: Sequence[str]) -> None:
        """What a person should know of how a recording was read, a line each."""

    def line(self, text: str) -> None:
        """What a running daemon reports on the way."""


class _Calling(Watcher):
    def __init__(self, callback: Callback) -> None:
        self._callback = callback

    def show(self, step: Step, seconds: float) -> None:
        self._callback(step)


class _Tqdm(Watcher):
    """A bar of tqdm for each phase that takes longer than QUIET_S."""

    def __init__(self, bar: Any) -> None:
        self._make = bar
        self._bar: Any = None

    def show(self, step: Step, seconds: float) -> None:
        if seconds < QUIET_S:
            return
        if self._bar is None:
            self._bar = self._make(total=step.total, desc=step.phase, leave=False, bar_format="{desc} {percentage:3.0f}% {bar} {postfix}")
        left = "" if step.seconds_left is None else f"{step.seconds_left:.0f} s left"
        self._bar.total, self._bar.n = step.total, step.done
        self._bar.set_postfix_str(" · ".join(filter(None, (left, step.detail))), refresh=False)
        self._bar.refresh()

    def line(self, text: str) -> None:
        self._make.write(text, file=sys.stderr)

    def ended(self, phase: str) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar = None


def watcher_of(progress: Callback | bool | None) -> Watcher:
    """Where a public function's progress goes.

    progress: a function that is called with a `Step`; True: tqdm; False: nowhere; None: tqdm if it is installed and somebody looks, on a
    terminal or in a notebook. Raises UsageError for True without tqdm.
    """
    if callable(progress):
        return _Calling(progress)
    if progress is False or (progress is None and not (_on_terminal() or "ipykernel" in sys.modules)):
        return Watcher()
    try:
        from tqdm import tqdm
    except ImportError:
        if progress is None:
            return Watcher()
        raise UsageError("progress=True: needs tqdm: pip install tqdm; or give a function that takes a Step") from None
    return _Tqdm(tqdm)


def _on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()
