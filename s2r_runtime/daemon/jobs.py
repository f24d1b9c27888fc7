"""What a worker does: load a controller, bound a gap, verify, trace. Each a pure function of its job, so that an audit can repeat it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from s2r_runtime.controllers.confinement import confine
from s2r_runtime.controllers.file import load
from s2r_runtime.daemon.worker import GapJob, Job, LoadJob, Result, TraceJob, VerifyJob
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Gap

Progress = Callable[[float, float, str], None]

MEMORY_BYTES = 4 << 30
"""What a controller may use in a verification: thousands of rollouts at once need more than driving, and less than a small computer has."""


def run(job: Job, progress: Progress) -> Result:
    """Does it. Raises S2RError with the reason where it can't be done."""
    match job:
        case LoadJob():
            if not Path(job.path).is_file():  # a device or a pipe may have no end
                raise ConfigError(f"{job.path}: is no file")
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
    """Rollouts of the controller on the uncertain model, under the profile's laws. From here on this process runs code that nobody
    has read, so it is confined first.
    """
    import numpy as np

    from s2r_runtime.controllers.hosted import batch_control
    from s2r_runtime.models.composed import compose
    from s2r_runtime.plugins import registry
    from s2r_runtime.uncertain import GapSet
    from s2r_runtime.verify import verify_in_detail

    profile, settings = job.profile, job.profile.verification
    model = compose(profile.model)
    task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    _discard_prints()
    confine(MEMORY_BYTES)
    result, details = verify_in_detail(
        batch_control(job.controller, len(model.inputs)),
        task,
        model,
        gap_set=GapSet(job.gap.set, job.gap.weights, job.radius, job.hold_radius, job.gap.hold_periods),
        laws=settings.laws,
        required=settings.required,
        n=settings.n,
        epsilon=settings.epsilon,
        beta=job.beta,
        threshold=settings.threshold,
        seed=job.seed,
        attempt=job.attempt,
        controller_digest=job.controller.digest,
        task_digest=profile.task_digest(),
        progress=progress,
    )
    lowest = -np.finfo(np.float64).max  # what `verify` counts a value that is no number as
    safety = {one.law: np.nan_to_num(one.rollouts.safety, nan=lowest, neginf=lowest, posinf=-lowest).tolist() for one in details}
    return Result(verification=result, safety=safety)


def _discard_prints() -> None:
    """What the controller prints goes nowhere. Confined, this process may not make a file longer: were stderr one, a print would raise
    OSError, and a controller that prints would not pass.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    os.close(nowhere)


def trace(job: TraceJob, progress: Progress) -> Result:
    """What the residual of a campaign depends on, and the model that has it, written to `job.out`. That model names what it was
    fitted on: the logs as they are now, and the samples, in whatever log they stand (guarantee G6).
    """
    import msgspec

    from s2r_runtime.daemon.persistence import replace
    from s2r_runtime.models.composed import compose
    from s2r_runtime.modelspec import dump_model
    from s2r_runtime.trace.tracer import load_dataset, trace
    from s2r_runtime.transitions import from_samples

    profile = job.profile
    model = compose(profile.model)
    weights = tuple(profile.norm.weights.get(name, 1.0) for name in model.states)
    found = trace(
        load_dataset(job.logs, model, epoch=job.epoch), model, seed=job.seed, progress=progress, weights=weights, kind=profile.norm.set
    )
    samples = from_samples(job.samples, source=f"campaign of epoch {job.epoch}").digest
    fitted = tuple(dict.fromkeys((*found.spec.fitted_on, samples)))
    text = dump_model(msgspec.structs.replace(found.spec, fitted_on=fitted), found.comments())
    replace(Path(job.out), text.encode())
    return Result(trace={**found.to_json(), "text": found.text(), "model_path": job.out, "model_toml": text})
