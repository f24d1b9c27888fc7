"""`s2r gap` and `s2r.gap`: the gap that a recording shows, and its statement (guarantee G1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from s2r_runtime.api.models import Chosen, ModelLike, ProfileLike, choose, weights_of
from s2r_runtime.api.options import check_counts, check_named_numbers, check_numbers
from s2r_runtime.api.progress import Callback, Watcher, watcher_of
from s2r_runtime.api.recordings import Recording, RecordingLike, as_recording, columns_of, signals_of, transport_of
from s2r_runtime.api.results import AFTER, LIMIT, Result, axes_of
from s2r_runtime.api.spelling import front_door
from s2r_runtime.evidence.gap import (
    blocked,
    discrepancy,
    doubted,
    estimate_gap,
    gap_json,
    noise_share,
    residuals,
)
from s2r_runtime.files.table_text import limits_of
from s2r_runtime.messages import NOT_INDEPENDENT, REPEATED, Gap
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.recordings.transitions import Transitions

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class GapResult(Result):
    """The sim2real gap of a model on a recording. Read `statement` before `radius`: without independent samples it claims nothing."""

    gap: Gap
    transitions: Transitions
    model: ComposedModel

    @property
    def radius(self) -> float:
        """The gap in the norm's unit: the largest discrepancy, or the largest but those discarded."""
        return self.gap.radius

    @property
    def independent(self) -> bool:
        """Whether the samples are independent draws, so that the statement claims something."""
        return self.transitions.independent

    @property
    def n(self) -> int:
        """Number of different transitions."""
        return self.gap.n

    @property
    def statement(self) -> str:
        """What is claimed, in sentences."""
        return str(self.to_dict()["statement"])

    @property
    def notes(self) -> tuple[str, ...]:
        """How the recording was read, one line each."""
        return self.transitions.notes

    def to_dict(self) -> dict[str, Any]:
        """What `s2r gap --json` prints."""
        return gap_json(self.gap, self.transitions, self.model.states)

    def summary(self) -> str:
        """What `s2r gap` prints."""
        answer, lines = self.to_dict(), []
        lines.append(f"gap radius      {answer['radius']:.6g}   (unweighted norm: {answer['radius_literal']:.6g})")
        if answer["hold_periods"] > 1:
            lines.append(f"hold gap        {answer['hold_radius']:.6g} over {answer['hold_periods']} periods")
        if answer.get("radius_noise"):
            lines.append(f"noise alone     would make about {noise_share(answer['radius_noise'], answer['radius'])} of it")
        lines.append(f"transitions     {answer['n']}, {answer['discarded']} discarded, rejected: {answer['rejected'] or 'none'}")
        if self.transitions.subset is not None:
            lines.append(f"subset          {self.transitions.subset.text()}")
        weights = ", ".join(f"{name} {weight:g}" for name, weight in answer["weights"].items())
        lines.append(f"norm            {answer['set']}, weights {weights}")
        lines.append("residual        " + ("white" if answer["white"] else f"not white: {answer['white_reason']}"))
        return "\n".join([*lines, answer["statement"]])

    def plot(self, ax: Axes | None = None) -> Axes:
        """Histogram of the discrepancies, with the gap as a line. Returns the axes."""
        (here,) = axes_of(1, ax)
        e = residuals(self.model, self.transitions)
        values = discrepancy(e, np.array(self.gap.weights), self.gap.set)
        here.hist(values, bins=min(60, max(10, len(values) // 10)), color=AFTER)
        here.axvline(self.radius, color=LIMIT, label=f"gap {self.radius:.3g}")
        here.set_xlabel("discrepancy after one step, in the norm's unit")
        here.set_ylabel("transitions")
        here.legend(frameon=False)
        return here


@front_door
def gap(
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
    epsilon: float | None = None,
    beta: float | None = None,
    discard: int | None = None,
    set: Literal["ball", "box"] | None = None,  # noqa: A002 - as the command line calls it
    weight: Mapping[str, float] | None = None,
    blocking: float | None = None,
    progress: Callback | bool | None = None,
) -> GapResult:
    """The sim2real gap of a model on a recording, and its statement.

    recording, column, state, input, dbc, max_gb: as `s2r.recording`. model, dt, param: as `s2r.model`, else the profile's model.
    epsilon, beta: violation probability, and one minus the confidence (defaults: the profile's, else 0.01 and 0.05). discard: number of
    the largest discrepancies to leave out, fixed beforehand (default 0). set: shape of the gap set (default `ball`). weight: state ->
    weight in the norm (default 1). blocking: s; of ordinary driving, assume that transitions so far apart are independent.
    progress: a function that takes a `Step`; True: tqdm; False: none.

    A recording whose transitions are not independent gives its numbers and `independent == False`. Raises RecordingError (unreadable,
    a column is missing), NotEnoughEvidence (too few samples: `missing` more; or the model was fitted on them), ConfigError, UsageError.
    """
    check_numbers(dt=dt, epsilon=epsilon, beta=beta, blocking=blocking, max_gb=max_gb)
    check_counts(discard=discard)
    check_named_numbers(param=param, weight=weight)
    given = as_recording(recording, column, state, input, dbc, max_gb)
    chosen = choose(model, profile, dt, param)
    return measure(
        given, chosen, watcher_of(progress), epsilon=epsilon, beta=beta, discard=discard, shape=set, weight=weight, blocking=blocking
    )


def measure(
    given: Recording,
    chosen: Chosen,
    watcher: Watcher,
    *,
    epsilon: float | None = None,
    beta: float | None = None,
    discard: int | None = None,
    shape: Literal["ball", "box"] | None = None,
    weight: Mapping[str, float] | None = None,
    blocking: float | None = None,
) -> GapResult:
    """As `gap`, of what was chosen. shape: of the gap set."""
    model, profile, _ = chosen
    columns, signals = columns_of(given, model, profile), signals_of(given.state, given.input, model)
    transport, limits = transport_of(given.dbc, profile), limits_of(given.max_gb)
    with watcher.phase("reading") as report:
        found = load_transitions(given.sources, model, columns, transport=transport, signals=signals, limits=limits, progress=report)
    watcher.notes(found.source, found.notes)
    if blocking is not None:
        found = blocked(found, blocking, model.dt)
    result = estimate_gap(
        model,
        found,
        epsilon=epsilon if epsilon is not None else profile.guarantee.epsilon if profile else 0.01,
        beta=beta if beta is not None else profile.guarantee.beta if profile else 0.05,
        discard=discard if discard is not None else profile.guarantee.discard if profile else 0,
        kind=shape or (profile.norm.set if profile else "ball"),
        weights=weights_of(model.states, weight or {}, profile),
    )
    # of a table nobody knows in which order its segments were drawn: the statement has it instead
    found = doubted(result, found, NOT_INDEPENDENT if found.samples_digest else (REPEATED,))
    return GapResult(result, found, model)
