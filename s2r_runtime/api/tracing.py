"""`s2r trace` and `s2r.trace`: residual -> effect -> repaired model -> error before and after."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_runtime.api.models import Chosen, Model, ModelLike, ProfileLike, choose, weights_of, write_text
from s2r_runtime.api.options import check_counts, check_named_numbers, check_numbers
from s2r_runtime.api.progress import Callback, Watcher, watcher_of
from s2r_runtime.api.recordings import Recording, RecordingLike, as_recording, columns_of, signals_of, transport_of
from s2r_runtime.api.results import AFTER, BEFORE, MEASURED, Result, axes_of, labelled
from s2r_runtime.api.spelling import front_door
from s2r_runtime.errors import UsageError
from s2r_runtime.evidence.seen_rows import seen
from s2r_runtime.files.table_text import limits_of
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import dump_model, is_sketch
from s2r_runtime.profile import Profile
from s2r_runtime.trace.pipeline import load_dataset
from s2r_runtime.trace.pipeline import trace as run_trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from s2r_runtime.trace.data.dataset import Dataset
    from s2r_runtime.trace.design.suggestion import Suggestion
    from s2r_runtime.trace.reporting.result import TraceResult

MAX_SUGGESTED_STEPS = 100_000
"""Steps of a suggested sequence: many are drawn, and every competing hypothesis is simulated under each."""

Bounds = dict[str, tuple[float, float]]


class Ready(NamedTuple):
    """Recordings that were read on the model's grid. test: the one to evaluate on, or None."""

    chosen: Chosen
    data: Dataset
    test: Dataset | None


@dataclass(frozen=True, eq=False, repr=False)
class Trace(Result):
    """What a model lacks, and the repaired model."""

    result: TraceResult
    """For the functions of this package."""
    ready: Ready

    @property
    def verdict(self) -> str:
        """`none`, `traced`, `ambiguous`, `unexplained` or `sensor_fault`."""
        return self.result.verdict

    @property
    def effects(self) -> tuple[dict[str, Any], ...]:
        """Identified effects: `name`, `channel`, `parameters` with `value`, `low`, `high` (95 %) and `unit`."""
        return tuple(one.to_json() for one in self.result.effects)

    @property
    def ambiguous_with(self) -> tuple[dict[str, Any], ...]:
        """Competing hypotheses that these data do not distinguish, as `effects`."""
        return tuple(self.to_dict()["ambiguous_with"])

    @property
    def error(self) -> dict[str, Any]:
        """Errors by state before and after, one step and rollouts, and the noise floor, in SI units."""
        return dict(self.to_dict()["error"])

    @property
    def notes(self) -> tuple[str, ...]:
        """How the recording was read, one line each."""
        return self.result.notes

    @property
    def model(self) -> Model:
        """The repaired model; the given one if nothing was added. `model.save(path)` writes what `s2r trace -o` writes."""
        own = self.ready.chosen.own
        return Model(compose(self.result.spec, "model", own), self.result.comments(), own)

    def to_dict(self) -> dict[str, Any]:
        """What `s2r trace --json` prints."""
        return self.result.to_json()

    def summary(self) -> str:
        """What `s2r trace` prints."""
        return self.result.text()

    def model_toml(self) -> str:
        """The text of the repaired model's file, as `s2r trace -o` writes it."""
        return dump_model(self.result.spec, self.result.comments())

    def save_report(self, path: Path | str) -> Path:
        """Writes the page with plots that `s2r trace --report` writes. Raises ConfigError without matplotlib, UsageError."""
        from s2r_runtime.report.trace_page import trace_page

        return write_text(path, trace_page(self.result, None))

    @front_door
    def suggest(self, *, suggest_duration: float | None = None, seed: int = 0) -> Suggestion:
        """The inputs that would distinguish what these data do not, within the profile's bounds, or those of the recording.

        suggest_duration: s. The result has `u` (m, nu), one row a step, or `u is None` and `refused`; `text()` and `to_csv()`.
        """
        check_numbers(above=0.0, suggest_duration=suggest_duration)
        check_counts(seed=seed)
        return suggested(self, suggest_duration, seed)

    def _repr_html_(self) -> str:
        """The verdict, a table of effects, and the account folded."""
        cells = [
            (effect["name"], effect["channel"], name, f"{value['value']:.4g}", f"{value['low']:.4g} to {value['high']:.4g}", value["unit"])
            for effect in self.effects
            for name, value in effect["parameters"].items()
            if all(isinstance(value[part], float) for part in ("value", "low", "high"))
        ]
        head = "".join(f"<th>{name}</th>" for name in ("effect", "on", "parameter", "value", "95 % interval", "unit"))
        body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in line) + "</tr>" for line in cells)
        table = f"<table><tr>{head}</tr>{body}</table>" if cells else ""
        first, _, rest = str(self).partition("\n")
        folded = f"<details><summary>details</summary><pre>{html.escape(rest)}</pre></details>"
        return f"<div><p><strong>{html.escape(first)}</strong></p>{table}{folded}</div>"

    def plot(self, ax: Axes | None = None) -> list[Axes]:
        """Rollouts of the model before and after, and the measurement, for each state. Returns the axes.

        They are on data that the fit never saw, where the rollouts before end farthest away. ax: the first state alone, there.
        """
        shown = {state: one for state, one in self.result.plots()["rollout"].items() if one}
        if not shown:
            raise UsageError("plot: there is no rollout of this length in what was held out; give a shorter horizon")
        units: dict[str, str] = getattr(self.result.nominal.nominal, "units", {})
        axes = axes_of(len(shown), ax, height_in=2.0)
        for here, (state, one) in zip(axes, shown.items(), strict=False):
            here.plot(one["t"], one["measured"], color=MEASURED, linewidth=1.2, label="measured")
            here.plot(one["t"], one["before"], color=BEFORE, linewidth=1.0, label="before")
            here.plot(one["t"], one["after"], color=AFTER, linewidth=1.0, linestyle="--", label="after")
            here.set_ylabel(labelled(state, units.get(state, "")))
        axes[0].legend(frameon=False, ncols=3, loc="best")
        axes[-1].set_xlabel("t (s)")
        return axes


@front_door
def trace(
    recording: RecordingLike,
    model: ModelLike | None = None,
    *,
    profile: ProfileLike | None = None,
    dt: float | None = None,
    param: Mapping[str, float] | None = None,
    column: Mapping[str, str] | None = None,
    state: Mapping[str, str] | None = None,
    input: Mapping[str, str] | None = None,  # noqa: A002 - as the command line calls it
    dbc: str | Path | None = None,
    max_gb: float | None = None,
    test: RecordingLike | None = None,
    horizon: float | None = None,
    seed: int = 0,
    bandwidth: float | None = None,
    progress: Callback | bool | None = None,
) -> Trace:
    """The effect that a model lacks, the repaired model, and the error before and after.

    recording, column, state, input, dbc, max_gb: as `s2r.recording`. model, dt, param: as `s2r.model`, else the profile's model.
    test: another recording to evaluate on, read alike (default: the last part of the first, which the fit never sees). horizon: length of
    the rollouts in s (default 1, or 10 steps if they take longer). seed: of everything random in it. bandwidth: Hz within which states
    that the recording lacks are reconstructed. progress: a function that takes a `Step`; True: tqdm; False: none.

    A DataFrame or dict gives bit for bit what `s2r trace` gives on a CSV of the same numbers. Raises NotEnoughEvidence (too few
    transitions, or no excitation), RecordingError (unreadable, a column is missing), ConfigError, UsageError.
    """
    check_numbers(dt=dt, max_gb=max_gb)
    check_numbers(above=0.0, horizon=horizon, bandwidth=bandwidth)
    check_counts(seed=seed)
    check_named_numbers(param=param)
    given = as_recording(recording, column, state, input, dbc, max_gb)
    tested = None if test is None else as_recording(test, None, None, None, None, None)
    watcher = watcher_of(progress)
    return run(
        read(given, choose(model, profile, dt, param), watcher, test=tested, horizon=horizon, bandwidth=bandwidth), watcher, horizon, seed
    )


def read(
    given: Recording,
    chosen: Chosen,
    watcher: Watcher,
    *,
    test: Recording | None = None,
    horizon: float | None = None,
    bandwidth: float | None = None,
) -> Ready:
    """Reads the recordings on the model's grid. Raises UsageError if the fit would see samples of `test` (guarantee G6)."""
    model, profile, _ = chosen
    if horizon is not None and horizon < model.dt:
        raise UsageError(f"--horizon {horizon:g}: must be at least the model's step, {model.dt:g} s")
    if bandwidth is not None and not bandwidth > 0.0:
        raise UsageError(f"--bandwidth {bandwidth:g}: must be > 0")
    columns, transport = columns_of(given, model, profile, test), transport_of(given.dbc, profile)
    signals = signals_of(given.state, given.input, model)
    with watcher.phase("reading") as report:
        load = partial(load_dataset, model=model, columns=columns, transport=transport, signals=signals)
        load = partial(load, limits=limits_of(given.max_gb), progress=report)
        data = load(given.sources, bandwidth=bandwidth)
        used = data.reconstruction.bandwidth if data.reconstruction and not data.reconstruction.axes else bandwidth
        tested = load(test.sources, bandwidth=used, behind=data.behind) if test else None
    for one in (data, tested):
        watcher.notes(one.source if one else "", one.notes if one else ())
    if test and tested and _seen_by_the_fit(data, tested):
        raise UsageError(
            f"--test {', '.join(map(str, test.sources))}: is the recording that the fit is made on, or has rows of it; "
            "take one that the fit never sees"
        )
    return Ready(chosen, data, tested)


def run(ready: Ready, watcher: Watcher, horizon: float | None = None, seed: int = 0) -> Trace:
    """Traces what was read. Raises NotEnoughEvidence."""
    (model, profile, _), data, test = ready
    with watcher.phase("tracing") as report:
        result = run_trace(
            data,
            model,
            test=test,
            horizon=horizon,
            seed=seed,
            progress=report,
            weights=weights_of(model.states, {}, profile),
            kind=profile.norm.set if profile else "ball",
        )
    return Trace(result, ready)


def suggested(found: Trace, duration: float | None, seed: int) -> Suggestion:
    """A sequence of inputs that would distinguish what the data do not. duration: s. Raises UsageError."""
    from s2r_runtime.trace.design.suggest import suggest

    check_duration(duration, found.ready.chosen)
    bounds, region = _allowed(found.ready.chosen.profile)
    return suggest(found.result, bounds=bounds, region=region, duration=duration, seed=seed)


def suggested_first(ready: Ready, duration: float | None, seed: int) -> Suggestion:
    """A first sequence of inputs, for a recording that cannot be traced, where a profile gives bounds."""
    from s2r_runtime.trace.design.suggest import suggest_first

    bounds, region = _allowed(ready.chosen.profile)
    return suggest_first(ready.chosen.model, ready.data, bounds=bounds, region=region, duration=duration, seed=seed)


def check_duration(duration: float | None, chosen: Chosen) -> None:
    """Raises UsageError for a sequence that is too long to design."""
    most = MAX_SUGGESTED_STEPS * chosen.model.dt
    if duration and duration > most:
        raise UsageError(f"--suggest-duration {duration:g}: must be at most {most:g} s, {MAX_SUGGESTED_STEPS} steps of the model")


def _seen_by_the_fit(data: Dataset, test: Dataset) -> bool:
    if set(test.digests) & set(data.digests):
        return True
    measured = [states.values for states, _ in test.segments]
    return any(seen(text, measured).refused for text in data.digests if is_sketch(text))


def _allowed(profile: Profile | None) -> tuple[Bounds | None, Bounds | None]:
    """Bounds of the inputs, and of the states: the geofence where there is one, else the region."""
    return (dict(profile.inputs), {**profile.region, **profile.geofence}) if profile else (None, None)
