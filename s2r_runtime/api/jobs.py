"""Work in a worker process, as the verbs order it: what a job needs, and waiting for its result."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from s2r_runtime.api.models import weights_of
from s2r_runtime.api.progress import Watcher
from s2r_runtime.messages import Gap
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.profile import Profile

if TYPE_CHECKING:
    from s2r_runtime.daemon.worker import Failed, Job
    from s2r_runtime.daemon.worker import Result as Done


def gap_at(radius: float, hold_radius: float | None, model: ComposedModel, profile: Profile) -> Gap:
    """A gap of that radius that nobody measured: for `--radius`."""
    periods = profile.sampling.hold_periods
    return Gap(
        radius=radius,
        radius_literal=radius,
        hold_radius=hold_radius or radius * periods**0.5,
        hold_periods=periods,
        set=profile.norm.set,
        weights=weights_of(model.states, {}, profile),
        n=0,
        discarded=0,
        epsilon=profile.guarantee.epsilon,
        beta=profile.guarantee.beta,
        epoch=0,
        model_digest=model.spec.digest(),
        transitions_digest="",
    )


def work(job: Job, timeout_s: float, label: str, watcher: Watcher) -> Done | Failed:
    """What a worker process makes of the job."""
    from s2r_runtime.daemon.worker import Progress, Worker

    worker = Worker(job, timeout_s)
    try:
        with watcher.phase(label) as report:
            while True:
                for message in worker.poll(time.monotonic_ns()):
                    if isinstance(message, Progress):
                        report(message.done, message.total, message.detail)
                    else:
                        return message
                time.sleep(0.01)
    finally:
        worker.stop()
