"""The account that a person reads in twenty seconds: what was left over and what it follows, what explains it, before and after,
what is still there, what is wrong with the measurements, what was done to the data. 100 columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.file_model import FileModel
from s2r_runtime.trace.diagnostics.residual_plots import Component, Shape, components, derived, strongest, variables
from s2r_runtime.trace.estimation.prediction import rms
from s2r_runtime.trace.reporting.found import Found

if TYPE_CHECKING:
    from s2r_runtime.trace.reporting.result import TraceResult
    from s2r_runtime.trace.sensor_faults.fault import Fault

Array = NDArray[np.float64]

WIDTH = 100

LABEL = 12
"""Columns of the words on the left."""

LISTED = 6
"""Faults, and effects that could not have been seen, that are listed one by one."""

SEGMENTS = 8
"""Names of segments that are listed."""

TOLD, FOLLOWED, SEEN = 1.05, 0.3, 0.1
"""A part of the residual is spoken of from this many times the noise on; what it follows, from this share (of all of it) on."""

TOLD_AWAY = 1.25
"""The same at the end of rollouts, of which few are independent."""

HEADLINES = {
    "none": "nothing is left beyond noise: the model explains these data",
    "unexplained": "structure is left that no effect in the library accounts for, so it gets no name",
    "sensor_fault": "the measurements, not the motion, are wrong in places",
}

WANDERS = "what is left follows no input and no state: noise that is correlated in time"
"""The headline of `none` where something is left that no effect accounts for, and that need not be one."""

USUAL = 0.97
"""Share of the rollouts that must be far off, too, for that to be said."""

FAR_OFF = 2.0
"""Times the noise at the end of rollouts from which on what was found did not explain all."""

SOME_LEFT = 1.5
"""The same, from which on it is not said that nothing is left. Rollouts are few, and not independent: less may be chance."""

ARROW = "->"


def account(r: TraceResult) -> str:
    """The lines."""
    lines = [f"{r.verdict}: {headline(r)}", *_explained(r)]
    lines += ["", *labelled("left over", _left_over(r))]
    lines += ["", *_table(r), ""]
    lines += labelled("gap", _gap(r))
    lines += labelled("still there", _still_there(r))
    lines += labelled("faults", list(_faults(r)))
    lines += labelled("not shown", _unseen(r))
    lines += labelled("data", _data(r))
    return "\n".join(lines)


def headline(r: TraceResult) -> str:
    """What the verdict says, in a clause."""
    if r.rivals:
        return f"these data cannot decide between {1 + len(r.rivals)} explanations; the best is"
    if r.effects:
        count = len(r.effects)
        all_of_it = not _shown(r) and not _away(r, r.after.ends, FAR_OFF)
        explain = f"{'explains' if count == 1 else 'explain'} {'what' if all_of_it else 'a part of what'} was left over"
        return f"the model lacks {'one effect' if count == 1 else f'{count} effects'}, which {explain}"
    return WANDERS if r.verdict == "none" and _wanders(r) else HEADLINES[r.verdict]


def _wanders(r: TraceResult) -> bool:
    """Whether a verdict without an effect leaves noise that takes rollouts away."""
    return bool(r.depends_on) or bool(_away(r, r.after.ends, FAR_OFF))


def _explained(r: TraceResult) -> list[str]:
    lines = [line for e in r.effects for line in _known(r, e)]
    if r.rivals:
        lines += ["cannot be told from:", *(line for e in r.rivals for line in [*_known(r, e), *_in_place_of(r, e)])]
        lines += labelled("or", _nameless(r))
        lines += labelled("try next", [r.suggested_excitation or "", "(--suggest FILE.csv writes such a drive)"])
    elif r.any_shape_of:
        lines += labelled("or", _nameless(r))
    if r.partial:
        what = "explains a part, and makes the model better:" if r.repair is not None else "explains a part only, so no name is lent to it:"
        lines += [what, *(line for e in r.partial for line in _effect(e)), *labelled("repair", _partial_repair(r))]
    return lines


def _partial_repair(r: TraceResult) -> list[str]:
    """Errors at the end of held-out rollouts without and with what explains a part."""
    if r.repair is None:
        return []
    units: dict[str, str] = getattr(r.nominal.nominal, "units", {})
    ends = zip(r.nominal.states, rms(r.before.ends), rms(r.repair.ends), strict=True)
    inverted = []
    if r.before.input_relative is not None and r.repair.input_relative is not None:
        inverted = [f"input error {_percent(r.before.input_relative)} {ARROW} {_percent(r.repair.input_relative)} of the input's norm"]
    each = ", ".join(f"{state} {_short(was)} {ARROW} {_short(now)} {units.get(state, '')}".rstrip() for state, was, now in ends)
    return [
        f"over {r.horizon_s:.4g} s on held-out data: {each}",
        *inverted,
        "-o MODEL.toml writes it, marked partial; no daemon adopts it by itself",
    ]


def _in_place_of(r: TraceResult, e: Found) -> list[str]:
    """Which of several effects a rival would replace."""
    if len(r.effects) < 2 or not e.instead_of:
        return []
    return [f"      in place of {' and '.join(f'{name} on {channel}' for name, channel in e.instead_of)}"]


def _nameless(r: TraceResult) -> list[str]:
    """What else it may be where many explanations tie."""
    shared = " and ".join(r.any_shape_of)
    return [f"by anything else that depends on {shared}: where several do alike, or add up, one without a name may, too"] if shared else []


def _known(r: TraceResult, e: Found) -> list[str]:
    """An effect, and other names for it."""
    others = [other for other in r.same(e) if (other.name, other.channel) != (e.name, "*")]  # on all of one input
    return [*_effect(e), *(line for other in others for line in _broken(f"      the same thing on this model: {other.text()}"))]


def _effect(e: Found) -> list[str]:
    words = e.words()
    return [*_broken(f"  {e.text()}"), *([f"      {words}"] if words else [])]


def _broken(line: str) -> list[str]:
    """Between numbers, to fit; what goes on stands four columns in."""
    lines, text = [], ""
    on = " " * (len(line) - len(line.lstrip()) + 4)
    for piece in line.split(", "):
        if text and len(text) + len(piece) + 4 > WIDTH:
            lines.append(f"{text},")
            text = f"{on}{piece}"
        else:
            text = f"{text}, {piece}" if text else piece
    return [*lines, text]


def _left_over(r: TraceResult) -> list[str]:
    """Of the model as it was given."""
    if r.verdict in {"none", "sensor_fault"}:
        far = _away(r, r.before.ends, FAR_OFF)
        return [f"nothing beyond noise in one step; {far}" if far else "nothing beyond noise"]
    over = variables(r.nominal, r.held)
    inputs = over[: len(r.nominal.inputs)]
    over += derived(r.nominal, r.held)
    there = _away(r, r.before.ends, TOLD_AWAY)
    away = [there] if there else []
    if r.verdict == "unexplained":  # some of the structure may still be in the noise: shares are of all, noise included
        parts = components(r.nominal, r.held, r.before.one_step, r.after.one_step, 0.0 * r.floor[0])
        told = [v for v in over if v.token in r.depends_on]
        shapes = [s for s in strongest(parts, told, inputs) if s.share > SEEN and s.variable is not None] if told else []
        said = [f"{s.component.said}: {_percent(s.share)} of it, noise included, {s.said}" for s in shapes[:2]]
        hidden = ["structure, which the transitions that were held out do not show"]
        return [*said, *away] or [_louder(part) for part in loud(r)] or hidden
    beyond = loud(r)
    shapes = strongest(beyond, over, inputs)
    return (
        [*(_told(s) for s in shapes[:3]), *away] if beyond else [f"nothing beyond noise in one step{'; ' if away else ''}{''.join(away)}"]
    )


def loud(r: TraceResult) -> list[Component]:
    """Parts of the residual of one step that are beyond the noise on what was held out."""
    parts = components(r.nominal, r.held, r.before.one_step, r.after.one_step, r.floor[0])
    return [p for p in parts if float(rms(p.before)) > TOLD * p.floor]


def _told(shape: Shape) -> str:
    """One line about a part of the residual and what it follows."""
    follows = f"{_percent(shape.share)} of that {shape.said}" if shape.share > FOLLOWED else "it follows no single variable"
    return f"{_louder(shape.component)}; {follows}"


def _louder(part: Component) -> str:
    return f"{part.said}: {float(rms(part.before)) / max(part.floor, 1e-300):.3g} times the noise in one step"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _away(r: TraceResult, ends: Array, least: float) -> str:
    """The state that is farthest beyond its noise at the ends of rollouts, (m, nx) errors; nothing if that is less than `least` times."""
    if not len(ends):
        return ""
    ratio = rms(ends) / r.floor[1].clip(1e-300)
    worst = int(ratio.argmax())
    usual = np.sort(np.abs(ends[:, worst]))[: max(1, round(USUAL * len(ends)))]  # a few wild rows are outliers, and counted
    if min(ratio[worst], float(np.sqrt(np.mean(usual**2))) / max(float(r.floor[1][worst]), 1e-300)) <= least:
        return ""
    return f"{r.nominal.states[worst]} ends {float(ratio[worst]):.3g} times the noise away after {r.horizon_s:.4g} s"


def _table(r: TraceResult) -> list[str]:
    """One row a state, and one in degrees for an angle. Before and after are one column where nothing was added."""
    units: dict[str, str] = getattr(r.nominal.nominal, "units", {})
    pairs = [(rms(r.before.one_step), rms(r.after.one_step), r.floor[0])]
    if len(r.before.ends):
        pairs.append((rms(r.before.ends), rms(r.after.ends), r.floor[1]))
    changed = r.model.effects != r.nominal.effects
    what = f"before {ARROW} after" if changed else "error"
    over = [f"one step ({r.nominal.dt:.4g} s)", f"over {r.horizon_s:.4g} s"][: len(pairs)]
    head = [f"{'error, rms':<18}" + "".join(f"{text:^38}" for text in over).rstrip(), f"{'':<18}" + f"{what:>24}{'noise':>14}" * len(pairs)]
    rows = []
    for i, state in enumerate(r.nominal.states):
        unit = units.get(state, "")
        for name, factor in [(unit, 1.0)] + ([("deg", math.degrees(1.0))] if unit == "rad" else []):
            row = f"{(f'{state} ({name})' if name else state):<18}"
            for before, after, floor in pairs:
                now = f"{_short(factor * before[i])} {ARROW} {_short(factor * after[i])}" if changed else _short(factor * before[i])
                row += f"{now:>24}{_short(factor * floor[i]):>14}"
            rows.append(row)
    if r.before.input_relative is not None and r.after.input_relative is not None:
        now = f"{100.0 * r.before.input_relative:.3g} %" + (f" {ARROW} {100.0 * r.after.input_relative:.3g} %" if changed else "")
        rows.append(f"{'input':<18}{now:>24}   of the input's norm, by the inverse model")
    return [*head, *rows]


def _short(value: float) -> str:
    return f"{value:.3g}"


def _gap(r: TraceResult) -> list[str]:
    before, after, independent = r.gap
    kind = "independent samples" if independent else "transitions of the drive, which bound no other (no statement)"
    now = f"{before['radius']:.4g} {ARROW} {after['radius']:.4g}" if r.effects else f"{before['radius']:.4g}"
    lines = [f"{now}, the largest of {before['n']} {kind}"]
    if "hold_radius" in before:
        now = f"{before['hold_radius']:.4g} {ARROW} {after['hold_radius']:.4g}" if r.effects else f"{before['hold_radius']:.4g}"
        lines.append(f"{now} after {before['hold_periods']} held periods")
    return lines


def _shown(r: TraceResult) -> tuple[str, ...]:
    """Of what is left, what it depends on beyond doubt."""
    return tuple(token for token in r.depends_on if token not in {*r.may_depend_on, *r.any_shape_of})


def _still_there(r: TraceResult) -> list[str]:
    """What is left for sure, and what may be."""
    look = ": look at the name again" if r.effects else ""
    beside = [f"less sure, but something may depend on {', '.join(r.may_depend_on)}{look}"]
    return [*_beyond_doubt(r), *(beside if r.may_depend_on else [])]


def _beyond_doubt(r: TraceResult) -> list[str]:
    away = _away(r, r.after.ends, FAR_OFF)
    if not _shown(r):
        if r.verdict == "unexplained":
            return ["structure; what it depends on cannot be told"]
        some = _away(r, r.after.ends, SOME_LEFT)
        nothing = f"nothing beyond noise in one step; {some}" if some else "nothing beyond noise"
        return [f"what no input and no state foretells: {away}" if away else nothing]
    if _shown(r) == ("noise",):
        whatever = "" if r.may_depend_on else ", whatever the inputs do"
        return [f"coloured noise: correlated in time{whatever}", *([away] if away else [])]
    percent = f"{100.0 * r.share_left:.0f} %" if r.share_left >= 0.01 else "under 1 %"
    much = f" ({percent} of what the model lacked)" if r.effects else ""
    lines = [f"structure{much} that depends on {', '.join(_shown(r))}"]
    return [*lines, "its shape is on the page that --report FILE.html writes"] if r.verdict == "unexplained" else lines


def _faults(r: TraceResult) -> Iterator[str]:
    """What stands at one time on several channels is one line; so is what several segments have."""
    loud = sorted((f for f in r.faults if f.kind != "dropout" and not f.segment), key=lambda f: (f.from_s, f.to_s, f.kind))
    grouped = [(key, [f.channel for f in found]) for key, found in groupby(loud, key=lambda f: (f.from_s, f.to_s, f.kind))]
    told = [f"{kind} of {_channels(channels)} {_when(begin, end)}" for (begin, end, kind), channels in grouped]
    told += _in_segments([f for f in r.faults if f.kind != "dropout" and f.segment])
    yield from told[:LISTED]
    if len(told) > LISTED:
        yield f"and {len(told) - LISTED} more (all of them: --json)"
    silent = [f for f in r.faults if f.kind == "dropout"]
    if silent:
        yield f"{len(silent)} dropout{'s' if len(silent) > 1 else ''}, the longest {max(f.to_s - f.from_s for f in silent):.3g} s"
    if any(f.kind != "late" for f in r.faults):
        yield "what they spoil is left out"


def _in_segments(faults: Sequence[Fault]) -> list[str]:
    """Those of recordings whose runs have names."""
    at: dict[tuple[str, float, float, str], list[str]] = {}
    for f in faults:
        at.setdefault((f.segment, f.from_s, f.to_s, f.kind), []).append(f.channel)
    alike: dict[str, list[tuple[str, float, float]]] = {}
    for (segment, begin, end, kind), channels in at.items():
        alike.setdefault(f"{kind} of {_channels(channels)}", []).append((segment, begin, end))
    told = []
    for what, places in alike.items():
        names = list(dict.fromkeys(segment for segment, _, _ in places))
        if len(names) == 1:
            told += [f"{what} in segment {segment} {_when(begin, end)}" for segment, begin, end in places]
            continue
        more = f" and {len(names) - SEGMENTS} more (all of them: --json)" if len(names) > SEGMENTS else ""
        told.append(f"{what} in segments {', '.join(names[:SEGMENTS])}{more}")
    return told


def _channels(channels: Sequence[str]) -> str:
    return ", ".join("all" if c == "*" else c for c in channels)


def _when(begin: float, end: float) -> str:
    return f"at {begin:.3f} s" if end == begin else f"from {begin:.3f} to {end:.3f} s"


def _unseen(r: TraceResult) -> list[str]:
    """Effects of which `none` on these data says nothing."""
    blind = [f"{name}({channel})" for name, channel in r.blind]
    if not blind or r.verdict not in {"none", "traced"}:
        return []
    more = f" and {len(blind) - LISTED} more" if len(blind) > LISTED else ""
    return [f"{', '.join(blind[:LISTED])}{more}: these data could not have shown that (--suggest FILE.csv writes a drive that does)"]


def _data(r: TraceResult) -> list[str]:
    runs = len({int(run) for run in r.held.steps.run}) if r.held.data.source != r.source else len(r.held.data.runs)
    on = "on the model's step " if r.nominal.dt == r.spec.dt else ""
    lines = [f"{r.n_rows} rows in {runs} run{'s' if runs > 1 else ''}, {on}as recorded", *_assumed(r)]
    lines += list(r.done_to_data)
    if r.outliers:
        lines.append(f"{r.outliers} outlying {'row counts' if r.outliers == 1 else 'rows count'} for next to nothing")
    lines.append(f"fitted on {r.n_fit} transitions, judged on {len(r.held.steps)} that the fit never saw")
    return lines


def _assumed(r: TraceResult) -> list[str]:
    """Numbers of a model of others that are what they are because nobody said: a wheel base that was forgotten is traced as a gain."""
    model, said = r.nominal.nominal, r.nominal.spec.parameters
    unsaid = {} if isinstance(model.shared, FileModel) else {k: v for k, v in model.parameters.items() if k not in said}
    if not unsaid:
        return []
    numbers = ", ".join(f"{name} = {value:g}" for name, value in unsaid.items())
    return [f"nobody said otherwise, so as the model has it: {numbers} (--param {next(iter(unsaid))}=... if it is another)"]


def labelled(label: str, lines: Sequence[str]) -> list[str]:
    """Lines behind a word on the left, broken at words to fit."""
    fitting = [piece for line in lines for piece in _wrapped(line)]
    return [f"{label if i == 0 else '':<{LABEL}}{line}" for i, line in enumerate(fitting)]


def _wrapped(text: str) -> list[str]:
    """At words, to fit behind a label."""
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > WIDTH - LABEL:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}" if line else word
    return [*lines, line] if line else lines
