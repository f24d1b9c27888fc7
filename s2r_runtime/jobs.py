"""What a worker does: load a controller, bound a gap, verify, trace. Each a pure function of its job, so that an audit can repeat it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from s2r_runtime.controller_file import load
from s2r_runtime.messages import Gap
from s2r_runtime.worker import GapJob, Job, LoadJob, Result, TraceJob, VerifyJob

Progress = Callable[[float, float, str], None]


def run(job: Job, progress: Progress) -> Result:
    """Does it. Raises S2RError with the reason where it can't be done."""
    match job:
        case LoadJob():
            return Result(controller=load(Path(job.path), job.parameters))
        case GapJob():
            return Result(gap=gap(job))
        case VerifyJob():
            return verify(job, progress)
        case TraceJob():
            return trace(job, progress)


def gap(job: GapJob) -> Gap:
    """The gap of the profile's model on a campaign's samples; the epoch's share of beta covers both radii."""
    from s2r_runtime.gap import estimate_gap
    from s2r_runtime.models.composed import compose
    from s2r_runtime.transitions import from_samples

    profile = job.profile
    model = compose(profile.model)
    return estimate_gap(
        model,
        from_samples(job.samples, rejected=job.rejected, source=f"campaign of epoch {job.epoch}"),
        epsilon=profile.guarantee.epsilon,
        beta=job.beta,
        discard=profile.guarantee.discard,
        kind=profile.norm.set,
        weights=tuple(profile.norm.weights.get(name, 1.0) for name in model.states),
        epoch=job.epoch,
    )


def verify(job: VerifyJob, progress: Progress) -> Result:
    """Rollouts of the controller on the uncertain model, under the profile's laws."""
    raise AssertionError


def trace(job: TraceJob, progress: Progress) -> Result:
    """The residual's structure, and the model that has it."""
    raise AssertionError
