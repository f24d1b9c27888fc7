"""Analytics that loads slowly, on a busy computer, comes up all the same while the robot is observed."""

from __future__ import annotations

import os
import selectors
import signal
import time

import pytest
from test_worker import gap, profile, step

from s2r_runtime.daemon import analytics
from s2r_runtime.daemon.analytics import Watching
from s2r_runtime.daemon.workshop import Watcher
from s2r_runtime.messages import AnalyticsChanged, Event


def test_analytics_that_is_started_again_is_not_ended_for_what_it_could_not_hear_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    happened: list[Event] = []
    watcher = Watcher(selectors.DefaultSelector(), profile(), "test.toml", happened.append)
    try:
        watcher.facts()
        watcher.begin(Watching(profile().model, gap(), 0.5))
        os.kill(watcher.pid, signal.SIGKILL)
        monkeypatch.setattr(analytics, "REPLY_WITHIN_S", 0.02)  # no interpreter loads numpy in that time
        limit, k = time.monotonic() + 60.0, 0
        while not any(isinstance(event, AnalyticsChanged) and event.up for event in happened):
            assert time.monotonic() < limit, happened
            k += 1
            watcher.observed(step(k, 0.0)[0])
            watcher.tick(time.monotonic_ns())
            time.sleep(0.005)
    finally:
        watcher.close()
