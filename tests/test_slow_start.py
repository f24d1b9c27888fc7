"""Analytics on a busy computer: one that loads slowly comes up all the same, one that lags closes the gate and goes on where it was."""

from __future__ import annotations

import os
import selectors
import signal
import time
from collections.abc import Callable

from worker_rig import gap, profile, step

from s2r_runtime.daemon.analytics import Watching
from s2r_runtime.daemon.awake import TURN_S, AwakeClock
from s2r_runtime.daemon.workshop import Watcher
from s2r_runtime.messages import AnalyticsChanged, Event, Measured

HURRY = "[machine]\nwatch_delay = 0.1\nprocess_timeout = {timeout}\n"


def test_analytics_that_is_started_again_is_not_ended_for_what_it_could_not_hear_yet() -> None:
    happened: list[Event] = []
    hurried = profile(more=HURRY.format(timeout=0.1))  # no interpreter loads numpy in that time
    watcher = Watcher(selectors.DefaultSelector(), hurried, "test.toml", happened.append)
    try:
        watcher.facts()
        watcher.begin(Watching(profile().model, gap(), 0.5))
        os.kill(watcher.pid, signal.SIGKILL)
        limit, k = time.monotonic() + 60.0, 0
        while not any(isinstance(event, AnalyticsChanged) and event.up for event in happened):
            assert time.monotonic() < limit, happened
            k += 1
            watcher.observed(step(k, 0.0)[0])
            watcher.tick(time.monotonic_ns())
            time.sleep(0.005)
    finally:
        watcher.close()


def test_analytics_that_lags_closes_the_gate_and_watches_on_without_a_new_process() -> None:
    """It stands still for longer than anybody may drive unwatched, and for less than a process that hangs."""
    happened: list[Event] = []
    watcher = Watcher(selectors.DefaultSelector(), profile(more=HURRY.format(timeout=60.0)), "test.toml", happened.append)
    try:
        watcher.facts()
        watcher.begin(Watching(profile().model, gap(), 0.5))
        pid = watcher.pid
        os.kill(pid, signal.SIGSTOP)
        for k in range(3):
            observation, send = step(k, 0.0)
            watcher.observed(observation)
            watcher.sent(send)
        _until(lambda: not watcher.up, watcher)
        assert [(event.up, "behind the robot" in event.detail) for event in happened if isinstance(event, AnalyticsChanged)] == [
            (False, True)
        ]
        os.kill(pid, signal.SIGCONT)
        _until(lambda: watcher.up, watcher)
        assert [event.up for event in happened if isinstance(event, AnalyticsChanged)] == [False, True]
        assert watcher.pid == pid
        assert [event.n for event in happened if isinstance(event, Measured)] == [1, 2], "nothing that was observed goes unmeasured"
    finally:
        watcher.close()


def test_a_pause_of_the_daemon_is_not_held_against_analytics() -> None:
    """The daemon stands still for longer than a process may hang, and analytics with it, as on a machine that sleeps."""
    happened: list[Event] = []
    host_ns = 0
    awake = AwakeClock(lambda: host_ns)
    hasty = profile(more=HURRY.format(timeout=0.5))
    watcher = Watcher(selectors.DefaultSelector(), hasty, "test.toml", happened.append, clock=awake.now_ns)
    try:
        watcher.facts()
        watcher.begin(Watching(profile().model, gap(), 0.5))
        os.kill(watcher.pid, signal.SIGSTOP)
        watcher.observed(step(0, 0.0)[0])
        host_ns += 3_600_000_000_000
        awake.look()
        watcher.tick(host_ns)
        assert happened == []
        assert awake.stood_still_ns == 3_600_000_000_000 - round(TURN_S * 1e9)
        for _ in range(6):  # from here on the daemon is awake, and analytics is not
            host_ns += 100_000_000
            awake.look()
            watcher.tick(host_ns)
        assert [event.up for event in happened if isinstance(event, AnalyticsChanged)] == [False, False], "late, then hung"
    finally:
        watcher.close()


def _until(condition: Callable[[], bool], watcher: Watcher) -> None:
    limit = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < limit
        watcher.tick(time.monotonic_ns())
        time.sleep(0.005)
