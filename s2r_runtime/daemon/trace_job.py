"""The worker's trace: cuts the stretch that was ordered out of the logs, traces it, and says what it was made on, so that an audit can
do the same. Deterministic: the same rows, model, seed and options give the same result.

The log is still being written: the order to trace is the last record that counts, and is waited for. Nothing here is in a hurry: the
process steps back behind everything else on the machine.
"""

from __future__ import annotations

import contextlib
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.daemon.model_store import ModelStore
from s2r_runtime.daemon.worker import TraceJob
from s2r_runtime.errors import RecordingError
from s2r_runtime.messages import StartJob
from s2r_runtime.modelspec import COMPACT
from s2r_runtime.recording.logs import runs
from s2r_runtime.recording.stretches import CHANNELS, Cut, Rows, Stretches, log_identity

if TYPE_CHECKING:
    from collections.abc import Callable

    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile
    from s2r_runtime.trace.data.dataset import Dataset
    from s2r_runtime.trace.reporting.result import TraceResult

WRITTEN_WITHIN_S = 45.0
"""The recorder hands over what it has every 50 ms; a disk that takes nothing for this long is full. Nobody waits but this process."""
NICE = 10
VOLATILE = ("model_path", "cpu_s")
"""What a result says that does not follow from the log."""


def trace(job: TraceJob, progress: Callable[[float, float, str], None]) -> dict[str, Any]:
    """The result as the log holds it (docs/log-format.md). Raises S2RError with why there is none."""
    if job.cpu_s:
        seconds = max(1, round(job.cpu_s))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    cut, identities = (job.cut, job.identities) if job.cut is not None else _read(job)
    found, fitted = traced(job.profile, cut, identities, job.seed, progress, row_sketch=job.row_sketch)
    result: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(plain(job, cut, found, fitted), enc_hook=_number))
    if job.out and fitted.effects != job.profile.model.effects:
        path = Path(job.out)
        ModelStore(path, job.base).keep(fitted, found.comments())
        result["model_path"] = str(ModelStore(path, job.base).file(fitted.digest()))
    result["cpu_s"] = round(time.process_time(), 3)
    return result


def traced(
    profile: Profile,
    cut: Cut,
    identities: tuple[str, ...],
    seed: int,
    progress: Callable[[float, float, str], None],
    *,
    row_sketch: str = COMPACT,
) -> tuple[TraceResult, Any]:
    """What the tracer says; and the repaired model, which remembers what it was fitted on (guarantee G6): the stretch, its rows
    one by one (`row_sketch`: in which form, none if empty), a campaign's samples in whatever log they stand, and for anything else the
    whole log.
    """
    from s2r_runtime.models.composed import compose
    from s2r_runtime.recordings.loading import from_samples
    from s2r_runtime.trace.pipeline import trace as tracer

    model = compose(profile.model)
    about = cut.about
    source = f"{about.stretch} of epoch {about.epoch}"
    samples = from_samples(cut.samples, source=source) if cut.samples else None
    more = identities if samples is None else (samples.digest,)
    data = replace(dataset(model, cut, source, (about.digest,), form=row_sketch), campaign=samples)
    found = tracer(data, model, seed=seed, progress=progress, weights=weights(profile, model.states), kind=profile.norm.set)
    fitted = found.spec
    if fitted.effects != profile.model.effects:
        fitted = msgspec.structs.replace(fitted, fitted_on=tuple(dict.fromkeys((*fitted.fitted_on, *more))))
    return found, fitted


def plain(job: TraceJob, cut: Cut, found: TraceResult, fitted: Any) -> dict[str, Any]:
    """What stands in the log, but for VOLATILE."""
    from s2r_runtime.modelspec import dump_model

    new = found.model.effects[len(job.profile.model.effects) :] if len(found.effects) else ()
    why = ""
    if found.verdict != "traced":
        why = f"the verdict is {found.verdict}"
    elif fitted.effects == job.profile.model.effects:
        why = "no effect was added"
    elif any(getattr(a.effect, "timed", False) for a in found.model.effects if (a.effect.name, a.channel) in _names(found)):
        why = "an effect counts its time from this recording's start, so it foretells no other"
    return {
        **found.to_json(),
        "text": found.text(),
        "recording": msgspec.to_builtins(cut.about),
        "model": job.profile.model.digest(),
        "seed": job.seed,
        "options": options(job.profile, found.nominal.states, job.rows),
        "proposal": {"digest": fitted.digest(), "proposed": not why, "reason": why, "effects": [e.text() for e in found.effects]},
        "model_toml": dump_model(fitted, found.comments()),
        "model_path": "",
        "added": bool(new),
    }


def _number(value: Any) -> Any:
    """A library's own number or array as plain data."""
    return value.tolist()


def options(profile: Profile, states: Sequence[str], rows: int) -> dict[str, Any]:
    """What the tracer was told besides rows, model and seed."""
    from s2r_runtime.trace.pipeline import usual_horizon

    horizon_s = usual_horizon(profile.model.dt)
    return {"horizon_s": horizon_s, "weights": list(weights(profile, states)), "set": profile.norm.set, "rows": rows}


def weights(profile: Profile, states: Sequence[str]) -> tuple[float, ...]:
    """The norm's, one a state."""
    return tuple(profile.norm.weights.get(name, 1.0) for name in states)


def dataset(model: ComposedModel, cut: Cut, source: str, digests: tuple[str, ...], *, form: str = COMPACT) -> Dataset:
    """The stretch on the model's grid. Raises RecordingError if its rows are not of this model, or too far apart,
    NotEnoughEvidence if it is of one moment only.
    """
    from s2r_runtime.trace.data.dataset import from_streams
    from s2r_runtime.trace.data.readers import row_sketch

    for segment in cut.segments:
        for rows, names in ((segment.states, model.states), (segment.inputs, model.inputs)):
            if any(len(values) != len(names) for _, values in rows):
                raise RecordingError(f"{source}: its rows are not of {', '.join(names)}")
    segments = [(_stream(one.states, len(model.states)), _stream(one.inputs, len(model.inputs))) for one in cut.segments]
    seen = row_sketch(model, segments, form) if form else ()
    return replace(from_streams(model, segments, source, (*digests, *seen)), commanded=True)


def _stream(rows: Rows, width: int) -> Any:
    """Sorted by stamp; equal stamps keep their order."""
    import numpy as np

    from s2r_runtime.trace.data.dataset import Stream

    t = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    order = np.argsort(t, kind="stable")
    values = np.array([values for _, values in rows], dtype=np.float64).reshape(len(rows), width)
    return Stream(np.asarray(t[order] * 1e-9, dtype=np.float64), values[order])


def _names(found: TraceResult) -> set[tuple[str, str]]:
    return {(e.name, e.channel) for e in found.effects}


# ---------------------------------------------------------------- from logs that are being written


def _read(job: TraceJob) -> tuple[Cut, tuple[str, ...]]:
    """The stretch, and what stands for its logs."""
    _step_back()
    limit = time.monotonic() + WRITTEN_WITHIN_S
    while True:
        time.sleep(0.1)
        found = cut_out(job)
        if found is not None:
            return found
        if time.monotonic() > limit:
            raise RecordingError(f"the order to trace did not reach the log within {WRITTEN_WITHIN_S:g} s")


def cut_out(job: TraceJob) -> tuple[Cut, tuple[str, ...]] | None:
    """The stretch out of the job's logs, and what stands for them; None while the order is not in there yet."""
    stretches, keys = Stretches(job.rows), {}
    for parts in runs(_with_later_parts(job.logs), CHANNELS):
        run = parts[0].run
        stretches.begin_run(run)
        for reading in parts:
            keys[run] = reading.public_key
            for entry in reading:
                message = entry.message
                if isinstance(message, StartJob) and run == job.run and (message.kind, message.job_id) == ("trace", job.job_id):
                    return _cut(job, stretches, keys)
                stretches.take(entry.index, message)
            if reading.ending.kind == "broken":
                raise RecordingError(f"{reading.path}: is damaged {reading.ending.detail}")
    return None


def _cut(job: TraceJob, stretches: Stretches, keys: dict[str, bytes]) -> tuple[Cut, tuple[str, ...]]:
    cut = stretches.cut(job.stretch, job.epoch)
    if cut is None:
        raise RecordingError(f"nothing was recorded of the {job.stretch} of epoch {job.epoch}")
    return cut, tuple(log_identity(part.run, keys[part.run]) for part in cut.about.parts)


def _with_later_parts(logs: Sequence[str]) -> list[Path]:
    """A log may have gone on in another part since the order."""
    found = [Path(log) for log in logs]
    for path in list(found):
        found += [later for later in sorted(path.parent.glob(f"{path.stem}.[0-9][0-9][0-9]{path.suffix}")) if later not in found]
    return found


def _step_back() -> None:
    """Behind everything that wants the processor: a tenth of the weight, and no say in when it gets it."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICE)
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
