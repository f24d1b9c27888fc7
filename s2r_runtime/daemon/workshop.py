"""The daemon's helpers in other processes: workers, one a job, and the analytics process, kept alive.

Whatever happens to them becomes a call or an event with a name; a worker always comes to an end, analytics that died or hangs is
said to be down and started again.
"""

from __future__ import annotations

import contextlib
import selectors
import time
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from s2r_runtime.child import Child
from s2r_runtime.core import stream
from s2r_runtime.daemon.analytics import Analytics, Ready, Reply, Upward, Watching
from s2r_runtime.daemon.settings import ModelFacts
from s2r_runtime.daemon.worker import Failed, Job, Progress, Result, TraceJob, Worker
from s2r_runtime.messages import AnalyticsChanged, Event, Gap, Measured, Observation, Send, WatchStood
from s2r_runtime.profile import Profile

AGAIN_AFTER_NS = 1_000_000_000
"""Between two starts of analytics: one that dies at once must not keep a core busy."""


class _Running(NamedTuple):
    worker: Worker
    done: Callable[[Result | Failed], None]
    progress: Callable[[Progress], None]
    patient: bool


class Workshop:
    """Workers under way. `done` is called exactly once for each, from the daemon's loop. A trace stands still while there is any other
    work: somebody waits for that, and the robot may, too.
    """

    def __init__(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        self._running: list[_Running] = []

    def start(
        self, job: Job, timeout_s: float, done: Callable[[Result | Failed], None], progress: Callable[[Progress], None] = lambda _: None
    ) -> None:
        """Begins a job. A process that cannot be started is a job that failed."""
        try:
            worker = Worker(job, timeout_s)
        except OSError as error:
            done(Failed(f"the worker cannot be started: {error.strerror}"))
            return
        running = _Running(worker, done, progress, isinstance(job, TraceJob))
        self._running.append(running)
        self._yield_or_go_on()
        self._selector.register(worker, selectors.EVENT_READ, lambda _: self._poll(running, time.monotonic_ns()))

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return bool(self._running)

    def tick(self, now_ns: int) -> None:
        """Notices what is overdue. now_ns: the host's clock."""
        for running in list(self._running):
            self._poll(running, now_ns)

    def close(self) -> None:
        """Ends all workers; their `done` is not called any more."""
        for running in list(self._running):
            self._forget(running)

    def _poll(self, running: _Running, now_ns: int) -> None:
        for message in running.worker.poll(now_ns):
            if isinstance(message, Progress):
                running.progress(message)
            else:
                self._forget(running)
                running.done(message)

    def _forget(self, running: _Running) -> None:
        self._running.remove(running)
        self._selector.unregister(running.worker)
        running.worker.stop()
        self._yield_or_go_on()

    def _yield_or_go_on(self) -> None:
        now_ns, busy = time.monotonic_ns(), any(not one.patient for one in self._running)
        for one in self._running:
            if one.patient:
                (one.worker.pause if busy else one.worker.resume)(now_ns)


class Watcher:
    """The analytics process, kept alive. Events come through `emit`; t_ns is the daemon's to give."""

    def __init__(
        self,
        selector: selectors.BaseSelector,
        profile: Profile,
        where: str,
        emit: Callable[[Event], None],
        child: Child | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Starts it at once: what follows goes on while it loads. child: the process, if it was started earlier. clock: ns, of how long
        it is waited for.
        """
        self._selector, self._profile, self._where, self._emit, self._clock = selector, profile, where, emit, clock
        self._analytics: Analytics | None = Analytics(profile, where, child, clock)
        self._again_ns = 0
        self._ready = self._late = False
        self._watching: Watching | None = None
        self._stood: tuple[Gap, WatchStood] | None = None
        """Where the watch of that gap stands."""

    @property
    def pid(self) -> int:
        """Process id; 0 while it is down."""
        return self._analytics.pid if self._analytics is not None else 0

    @property
    def up(self) -> bool:
        """Whether it can measure, and is not behind the robot."""
        return self._analytics is not None and self._ready and not self._late

    def facts(self) -> ModelFacts:
        """Waits until it is up. Raises ConfigError with what is wrong with the profile."""
        assert self._analytics is not None  # noqa: S101 - just started
        facts = self._analytics.facts()
        self._register(self._analytics)
        self._ready = True
        return facts

    def use(self, profile: Profile) -> None:
        """The profile with another model from here on; a restart checks that one."""
        self._profile = profile

    def begin(self, watching: Watching) -> None:
        """Measures from here on; goes on where the watch of that epoch stood."""
        if self._stood is not None and self._stood[0].epoch == watching.gap.epoch:
            watching = msgspec.structs.replace(watching, **msgspec.structs.asdict(self._stood[1]))
        else:
            e_value = 1.0 if watching.e_value is None else watching.e_value
            stood = WatchStood(watching.n, watching.exceedances, e_value, watching.change, watching.exchange, watching.counts)
            self._stood = (watching.gap, stood)
        self._watching = watching
        if self._analytics is not None:
            self._analytics.watch(watching)

    def end(self) -> None:
        """Nobody drives any more."""
        self._watching = None

    def sent(self, send: Send) -> None:
        """The robot was told this."""
        if self._watching is not None and self._analytics is not None and self._ready:
            self._analytics.sent(send)

    def restarted(self) -> None:
        """The robot started anew, or the link to it was lost or found."""
        if self._watching is not None and self._analytics is not None and self._ready:
            self._analytics.restarted()

    def observed(self, observation: Observation) -> None:
        """The robot was seen there. A process that still loads its libraries is told nothing: it would be late with its answer, and ended
        for that, again and again on a busy computer.
        """
        if self._watching is not None and self._analytics is not None and self._ready:
            self._analytics.observed(observation)

    def wait(self) -> None:
        """Until all that was seen is measured (lockstep: one seed, one story)."""
        if self._watching is not None and self._analytics is not None:
            for message in self._analytics.wait():
                self._take(message)
            self._check_alive(time.monotonic_ns())

    def tick(self, now_ns: int) -> None:
        """Takes what came; notices its end; starts it again. now_ns: the host's clock."""
        if self._analytics is not None:
            for message in self._analytics.poll():
                self._take(message)
            self._check_late()
            self._check_alive(now_ns)
        elif now_ns >= self._again_ns:
            self._again_ns = now_ns + AGAIN_AFTER_NS
            try:
                self._analytics = Analytics(self._profile, self._where, clock=self._clock)
            except OSError:
                return  # no process to be had now; the gate stays closed
            self._register(self._analytics)

    def close(self) -> None:
        """Ends it."""
        if self._analytics is not None:
            with contextlib.suppress(KeyError):  # it did not get that far
                self._selector.unregister(self._analytics)
            self._analytics.stop()
            self._analytics = None

    def _register(self, analytics: Analytics) -> None:
        self._selector.register(analytics, selectors.EVENT_READ, lambda _: self.tick(time.monotonic_ns()))

    def _up(self) -> None:
        self._ready = True
        self._emit(AnalyticsChanged(0, up=True))
        if self._watching is not None:
            self.begin(self._watching)

    def _check_late(self) -> None:
        """Nobody may drive unwatched for longer than the profile allows; a process that catches up watches on where it was."""
        if self._analytics is None or self._analytics.down:
            return
        late = self._analytics.late
        if bool(late) != self._late and self._ready:
            self._late = bool(late)
            self._emit(AnalyticsChanged(0, up=not late, detail=late, late=True))

    def _check_alive(self, now_ns: int) -> None:
        analytics = self._analytics
        if analytics is None or not analytics.down:
            return
        self._selector.unregister(analytics)
        analytics.stop()
        self._analytics, self._ready, self._late = None, False, False
        self._again_ns = now_ns + AGAIN_AFTER_NS
        self._emit(AnalyticsChanged(0, up=False, detail=analytics.down))

    def _measured(self, measured: Measured) -> None:
        """Keeps where the watch stands, for a process that is started again."""
        if self._stood is not None and self._stood[0].epoch == measured.epoch:
            gap, before = self._stood
            self._stood = (gap, stream.after(before, measured, gap.radius))
        self._emit(measured)

    def _take(self, message: Upward) -> None:
        if isinstance(message, Reply):
            if message.measured is not None:
                self._measured(message.measured)
        elif isinstance(message, Ready):
            self._up()
        else:
            self._emit(AnalyticsChanged(0, up=False, detail=message.text))
