"""A verdict with its intervals, errors and gap before and after, as a result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.evidence.seen_rows import united
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.command_timing import before_changes
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.design.suggest import advice
from s2r_runtime.trace.diagnostics.detectability import visible
from s2r_runtime.trace.diagnostics.lack_of_fit import Structure
from s2r_runtime.trace.diagnostics.rollout_error import Held, Judged, Kind, at_most_seen, gaps, judge, noise_floor
from s2r_runtime.trace.diagnostics.validity_domain import domain_of
from s2r_runtime.trace.estimation.discretisation_error import widened
from s2r_runtime.trace.estimation.noise import no_colour
from s2r_runtime.trace.estimation.order_intervals import in_either_order
from s2r_runtime.trace.estimation.parameters import Slot, values_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, told, without
from s2r_runtime.trace.estimation.shrinkage import drawn_in
from s2r_runtime.trace.hypotheses.equivalence import other_names
from s2r_runtime.trace.reporting.found import each_once
from s2r_runtime.trace.reporting.result import Found, Limit, TraceResult
from s2r_runtime.trace.selection.lag_or_integrator import endless
from s2r_runtime.trace.selection.scores import name_of
from s2r_runtime.trace.selection.shared_dependence import any_shape_of
from s2r_runtime.trace.selection.stepwise import Selection
from s2r_runtime.trace.sensor_faults.detect import Checked
from s2r_runtime.trace.sensor_faults.fault import Fault
from s2r_runtime.trace.sensor_faults.pose_latency import late_faults
from s2r_runtime.trace.verdict import Verdict, asked, final_fit, helps, verdict_of, where_measured, worth_its_risk

Array = NDArray[np.float64]

WILD = 5.0
"""Standard deviations of a whitened residual from which it is counted as an outlier (and has next to no weight)."""


def answered(
    dataset: Dataset,
    checked: Checked,
    given: Problem,
    chosen: Selection,
    structure: Structure,
    judged_on: Held,
    seed: int,
    weights: Array,
    kind: Kind,
) -> TraceResult:
    """Verdict, intervals, errors and gap before and after."""
    there, near = given, chosen.fit
    if dataset.reconstruction is None:  # what a filter leaves has the filter's law, not the noise's
        fit, there, near = told(given, chosen.fit)
        chosen = replace(chosen, fit=drawn_in(given, fit, there, near))
    integrals = endless(chosen.fit, lambda: widened(there, near, in_either_order(there, near)), checked.data)
    if integrals:
        structure = replace(structure, tokens=tuple(dict.fromkeys((*integrals, *structure.tokens))), matters=True, share=1.0)
    decided = _decided(dataset, checked, chosen, structure, judged_on, seed)
    ranges = _with(chosen.fit, widened(there, near, in_either_order(there, near))) if decided.final is chosen.fit else {}
    return _recorded(dataset, checked, given, chosen, decided, ranges, judged_on, weights, kind)


def _with(fit: Fit, ranges: dict[Slot, tuple[float, float]]) -> dict[Slot, tuple[float, float]]:
    """The ranges, about the numbers as they are told: what was drawn in seldom leaves its own."""
    told_as = dict(zip(fit.free, values_of(fit.model, fit.free).tolist(), strict=True))
    return {slot: (min(low, told_as[slot]), max(high, told_as[slot])) for slot, (low, high) in ranges.items()}


@dataclass(frozen=True)
class _Decided:
    """final: the fit that the verdict leaves. before, after: of the model as given and with what was found; floor: rms that noise alone
    makes of one step and of rollouts, (nx,) each. repair: of what was found, where the verdict leaves it out and it helps all the same.
    """

    verdict: Verdict
    final: Fit
    structure: Structure
    faults: tuple[Fault, ...]
    before: Judged
    after: Judged
    floor: tuple[Array, Array]
    repair: Judged | None = None


def _decided(dataset: Dataset, checked: Checked, chosen: Selection, structure: Structure, judged_on: Held, seed: int) -> _Decided:
    """The verdict, and what is left of the fit by it."""
    nominal = chosen.nominal
    before, after = judge(nominal.model, judged_on), judge(chosen.fit.model, judged_on)
    floor = at_most_seen(noise_floor(chosen.fit, judged_on, seed), chosen.fit.model, judged_on, after.ends)
    forgets = replace(chosen.fit, colour=no_colour(len(nominal.model.states)))  # a law with a memory takes up what the model lacks
    alone = floor if chosen.fit.added else noise_floor(forgets, judged_on, seed)
    last = max(run.start_s + float(np.sum(run.durations(dataset.dt))) for run in dataset.runs)
    faults = (*late_faults(dataset.behind, last), *checked.faults)
    verdict = verdict_of(chosen, structure, faults, (before, after), judged_on, (floor[1], alone[1]))
    if verdict == "unexplained" and not {*structure.tokens} - {"noise"}:  # what was named foretells nothing: what else it looks like
        structure = replace(structure, tokens=structure.likeliest or structure.tokens)
    final = final_fit(chosen, verdict)
    told = before if final is nominal else after
    partial = verdict == "unexplained" and bool(chosen.fit.added) and helps(before, after, where_measured(floor[1], judged_on))
    if verdict == "unexplained":
        level, colour = structure.noise or (chosen.fit.noise, chosen.fit.colour)  # the structure itself is no noise
        floor = at_most_seen(noise_floor(replace(final, noise=level, colour=colour), judged_on, seed), final.model, judged_on, told.ends)
    elif final is not chosen.fit:
        floor = at_most_seen(noise_floor(final, judged_on, seed), final.model, judged_on, told.ends)
    return _Decided(verdict, final, structure, faults, before, told, floor, after if partial else None)


def _recorded(
    dataset: Dataset,
    checked: Checked,
    given: Problem,
    chosen: Selection,
    decided: _Decided,
    ranges: dict[Slot, tuple[float, float]],
    judged_on: Held,
    weights: Array,
    kind: Kind,
) -> TraceResult:
    """All that is told of a decision. ranges: 95 % intervals of what was fitted."""
    model, final, verdict, structure = chosen.nominal.model, decided.final, decided.verdict, decided.structure
    gap_before, gap_after, independent = gaps((model, decided.before), (final.model, decided.after), judged_on, weights, kind)
    effects = tuple(_found(model, final, place, ranges) for place in final.added)
    early = dataset.reconstruction.outliers if dataset.reconstruction else 0
    idle = [place for place in final.added if not asked(given, judged_on, final.model, without(final.model, place))]
    rivals = [s.fit for s in chosen.rivals if s.fit is not None] if verdict == "ambiguous" else []
    left = _in_order(structure, verdict)
    shared = tuple(token for token in any_shape_of(final, rivals, given.data, given.steps) if token not in left)
    ties = each_once(
        replace(_found(model, fit, place, {}), instead_of=tuple(name_of(final.model.effects[i]) for i in _new(final, fit)))
        for fit in rivals
        for place in _new(fit, final)
    )
    adopted = final if worth_its_risk(chosen, decided.before, decided.after) else chosen.nominal
    adopted = chosen.fit if decided.repair is not None else adopted
    return TraceResult(
        verdict=verdict,
        effects=effects,
        partial=() if final is chosen.fit else tuple(_found(model, chosen.fit, place, {}) for place in chosen.fit.added),
        repair=decided.repair,
        ambiguous_with=(
            *ties,
            *(other for place, e in zip(final.added, effects, strict=True) for other in other_names(final.model, place, e)),
        ),
        candidates=tuple((s.name, s.channel, s.score) for s in chosen.ranking),
        depends_on=tuple(dict.fromkeys((*shared, *left))),
        any_shape_of=shared,
        may_depend_on=() if verdict == "unexplained" else structure.beside,
        share_left=float(structure.share),
        suggested_excitation=advice(model, [(f.name, f.channel) for f in (*effects, *ties)]) if ties else None,
        faults=decided.faults,
        outliers=early + checked.outliers + int(np.count_nonzero(np.abs(final.z).max(axis=1) > WILD)),
        spec=_spec(model, adopted, dataset),
        model=final.model,
        nominal=model,
        before=decided.before,
        after=decided.after,
        floor=decided.floor,
        gap=(gap_before, gap_after, independent),
        held=judged_on,
        n_fit=len(given.steps),
        n_rows=dataset.rows,
        source=dataset.source,
        reconstruction=dataset.reconstruction,
        way=dataset.way,
        noisy=dataset.noisy,
        measured_forces=dataset.measured_forces,
        behind=dataset.behind,
        forgetting=checked.data.forgetting,
        unplaced=len(before_changes(checked.data)) if dataset.unplaced else 0,
        unconfirmed=tuple((final.model.effects[place].effect.name, final.model.effects[place].channel) for place in idle),
        domain=domain_of(model, (given.data, given.steps), (judged_on.data, judged_on.steps)),
        could_see=visible(given, final, chosen.tried),
    )


def _in_order(structure: Structure, verdict: str) -> tuple[str, ...]:
    """What is left first, where no name is given and it is more than noise; else what a name may depend on."""
    left = verdict == "unexplained" and {*structure.tokens} - {"noise"}
    return (*structure.tokens, *structure.beside) if left else (*structure.beside, *structure.tokens)


def with_time(result: TraceResult) -> TraceResult:
    """With the time last among what names may depend on, unless it is told already: what is left beyond doubt is not less sure by that."""
    if "time" in result.depends_on:
        return result
    left, beside = (tuple(dict.fromkeys((*tokens, "time"))) for tokens in (result.depends_on, result.may_depend_on))
    return replace(result, depends_on=left, may_depend_on=beside)


def _new(fit: Fit, other: Fit) -> list[int]:
    """Places of the effects of one fit that the other does not have."""
    there = {name_of(a) for a in other.model.effects}
    return [i for i in fit.added if name_of(fit.model.effects[i]) not in there]


def _found(model: ComposedModel, fit: Fit, place: int, ranges: dict[Slot, tuple[float, float]]) -> Found:
    a = fit.model.effects[place]
    values = {}
    for p in a.effect.parameters:
        value = a.p.get(p.name)
        if value is None:
            continue
        low, high = _limits(value, lambda entry, name=p.name: ranges.get(Slot(place, name, entry)))
        values[p.name] = (value, low, high, a.effect.unit(model.nominal, a.channel, p.name))
    return Found(a.effect.name, a.channel, values)


def _limits(value: object, at: Callable[..., tuple[float, float] | None]) -> tuple[Limit, Limit]:
    """Low and high in the shape of the value."""
    if not isinstance(value, list):
        return at(None) or (None, None)
    pairs = [[at((i, j)) or (None, None) for j in range(len(row))] for i, row in enumerate(value)]
    return [[low for low, _ in row] for row in pairs], [[high for _, high in row] for row in pairs]


def _spec(model: ComposedModel, final: Fit, data: Dataset) -> ModelSpec:
    """The repaired model; the one given, if nothing was added. Where steps were taken in parts, both have that."""
    if not final.added and len(model.effects) == len(model.spec.effects):
        return model.spec
    effects = tuple(EffectSpec(a.effect.name, a.channel, a.p) for a in final.model.effects)
    return msgspec.structs.replace(model.spec, effects=effects, fitted_on=united(model.spec.fitted_on, data.digests))
