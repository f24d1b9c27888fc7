"""Jobs of the worker, run to their end."""

from __future__ import annotations

import random
import time
from pathlib import Path

from daemon_rig import PROFILE

from s2r_runtime.controllers.file import load
from s2r_runtime.core.ledger import share
from s2r_runtime.daemon import jobs
from s2r_runtime.daemon.worker import GapJob, Job, Progress, Upward, VerifyJob, Worker
from s2r_runtime.messages import Gap, Observation, SampleTaken, Send
from s2r_runtime.profile import Profile, parse_profile

WITHIN_S = 60.0

GRID = Path(__file__).parents[2] / "controllers" / "grid.py"


def profile(clock: str = "lockstep", more: str = "") -> Profile:
    return parse_profile(PROFILE.format(clock=clock, more=more), "test.toml", Path())


def finished(job: Job, timeout_s: float = WITHIN_S) -> list[Upward]:
    """Everything that a worker says."""
    worker = Worker(job, timeout_s)
    try:
        return drained(worker)
    finally:
        worker.stop()
        worker.stop()


def drained(worker: Worker) -> list[Upward]:
    said: list[Upward] = []
    while not said or isinstance(said[-1], Progress):
        said += worker.poll(time.monotonic_ns())
        time.sleep(0.01)
    return said


def samples(n: int) -> tuple[SampleTaken, ...]:
    """Of a robot that does what the model says, but for noise of 0.1 mm."""
    rng = random.Random(3)

    def noisy(*x: float) -> tuple[float, ...]:
        return tuple(value + rng.gauss(0.0, 1e-4) for value in x)

    return tuple(
        SampleTaken(i, 1, i, 100 * i, 3_300_000_000 * i, (0.1, 0.0), noisy(0, 0, 0), noisy(0, 0, 0), noisy(0.0132, 0, 0), 5)
        for i in range(n)
    )


def gap_job(n: int = 8) -> GapJob:
    return GapJob(profile(), samples(n), {"timeout": 2}, 1, share(0.5, 1))


def gap() -> Gap:
    return jobs.gap(gap_job())


def verify_job(controller: Path = GRID, more: str = "") -> VerifyJob:
    found = gap()
    return VerifyJob(profile(more=more), load(controller), found, 1.5 * found.radius, 1.5 * found.hold_radius, 1, 12345, share(0.5, 1))


def step(k: int, x: float) -> tuple[Observation, Send]:
    """A robot that is at x at period k, and is commanded to stand still."""
    return Observation(k, 33_000_000 * k, (x, 0.0, 0.0)), Send(33_000_000 * k, k, "controller", (0.0, 0.0), k, 100_000_000)
