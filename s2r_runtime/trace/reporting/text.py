"""Text report of a trace, at most 100 columns wide.

The verdict and the effects; the residual of the given model; errors before and after; the remaining structure; faults of measurement; what
was done to the data.
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
"""Width of the labels, characters."""

LISTED = 6
"""Number of faults, and of undetectable effects, that are listed one by one."""

SEGMENTS = 8
"""Number of segment names that are listed."""

ABOVE_NOISE, FOLLOWED, MIN_SHARE = 1.05, 0.3, 0.1
"""Rms over noise from which a component of the residual is listed; shares of it, explained by a variable, from which that is listed."""

ROLLOUT_ABOVE_NOISE = 1.25
"""ABOVE_NOISE at the end of rollouts, of which few are independent."""

HEADLINES = {
    "none": "no unmodelled dynamics detected: the residual is consistent with noise",
    "unexplained": "the residual has structure that no effect in the library explains",
    "sensor_fault": "measurements are wrong at the times listed below; no effect is missing",
}

COLOURED = "no effect detected: the residual is noise that is correlated in time, independent of inputs and states"
"""Headline of `none` if the residual is not white."""

USUAL = 0.97
"""Share of the rollouts whose rms must exceed the limit, too: a few outliers do not count."""

FAR_OFF = 2.0
"""Rollout error over noise from which the effects explain only a part."""

SLIGHTLY_OFF = 1.5
"""The same, from which the error is mentioned. Rollouts are few and not independent: less may be chance."""

ARROW = "->"


def account(r: TraceResult) -> str:
    """Compose the report."""
    lines = [f"{r.verdict}: {headline(r)}", *_explained(r)]
    lines += ["", *labelled("residual", _residual(r))]
    lines += ["", *_table(r), ""]
    lines += labelled("gap", _gap(r))
    lines += labelled("remaining", _remaining(r))
    lines += labelled("faults", list(_faults(r)))
    lines += labelled("not shown", _unseen(r))
    lines += labelled("data", _data(r))
    return "\n".join(lines)


def headline(r: TraceResult) -> str:
    """One clause on the verdict."""
    if r.rivals:
        return f"{1 + len(r.rivals)} explanations are not distinguishable on this data; the best is"
    if r.effects:
        count = len(r.effects)
        all_of_it = not _shown(r) and not _away(r, r.after.ends, FAR_OFF)
        explain = f"{'explains' if count == 1 else 'explain'} {'the residual' if all_of_it else 'a part of the residual'}"
        return f"the model lacks {'one effect' if count == 1 else f'{count} effects'}, which {explain}"
    return COLOURED if r.verdict == "none" and _is_coloured(r) else HEADLINES[r.verdict]


def _is_coloured(r: TraceResult) -> bool:
    """Whether the residual of a verdict without an effect is coloured, or rollouts end beyond the noise."""
    return bool(r.depends_on) or bool(_away(r, r.after.ends, FAR_OFF))


def _explained(r: TraceResult) -> list[str]:
    lines = [line for e in r.effects for line in _known(r, e)]
    if r.rivals:
        lines += ["not distinguishable from:", *(line for e in r.rivals for line in [*_known(r, e), *_in_place_of(r, e)])]
        lines += labelled("or", _unnamed(r))
        lines += labelled("try next", [r.suggested_excitation or "", "(--suggest FILE.csv writes such inputs)"])
    elif r.any_shape_of:
        lines += labelled("or", _unnamed(r))
    if r.partial:
        what = "partial fit that improves the prediction:" if r.repair is not None else "partial fit, therefore not reported as a cause:"
        lines += [what, *(line for e in r.partial for line in _effect(e)), *labelled("repair", _partial_repair(r))]
    return lines


def _partial_repair(r: TraceResult) -> list[str]:
    """Errors at the end of held-out rollouts, without and with the effects of `partial`."""
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
    """Which of several effects an alternative would replace."""
    if len(r.effects) < 2 or not e.instead_of:
        return []
    return [f"      in place of {' and '.join(f'{name} on {channel}' for name, channel in e.instead_of)}"]


def _unnamed(r: TraceResult) -> list[str]:
    """Unnamed alternatives, if many explanations are not distinguishable."""
    shared = " and ".join(r.any_shape_of)
    return (
        [f"any unnamed effect that depends on {shared}: several explanations agree there, and one outside the library may, too"]
        if shared
        else []
    )


def _known(r: TraceResult, e: Found) -> list[str]:
    """An effect and its equivalents."""
    others = [other for other in r.same(e) if (other.name, other.channel) != (e.name, "*")]  # on all of one input
    return [*_effect(e), *(line for other in others for line in _broken(f"      the same thing on this model: {other.text()}"))]


def _effect(e: Found) -> list[str]:
    words = e.words()
    return [*_broken(f"  {e.text()}"), *([f"      {words}"] if words else [])]


def _broken(line: str) -> list[str]:
    """Break a line between parameters; continuation lines are indented by four more characters."""
    lines, text = [], ""
    on = " " * (len(line) - len(line.lstrip()) + 4)
    for piece in line.split(", "):
        if text and len(text) + len(piece) + 4 > WIDTH:
            lines.append(f"{text},")
            text = f"{on}{piece}"
        else:
            text = f"{text}, {piece}" if text else piece
    return [*lines, text]


def _residual(r: TraceResult) -> list[str]:
    """Residual of the given model, by component and variable."""
    if r.verdict in {"none", "sensor_fault"}:
        far = _away(r, r.before.ends, FAR_OFF)
        return [f"consistent with noise in one step; {far}" if far else "consistent with noise"]
    over = variables(r.nominal, r.held)
    inputs = over[: len(r.nominal.inputs)]
    over += derived(r.nominal, r.held)
    there = _away(r, r.before.ends, ROLLOUT_ABOVE_NOISE)
    away = [there] if there else []
    if r.verdict == "unexplained":  # some of the structure may still be in the noise: shares are of all, noise included
        parts = components(r.nominal, r.held, r.before.one_step, r.after.one_step, 0.0 * r.floor[0])
        reported = [v for v in over if v.token in r.depends_on]
        shapes = [s for s in strongest(parts, reported, inputs) if s.share > MIN_SHARE and s.variable is not None] if reported else []
        said = [f"{s.component.said}: {_percent(s.share)} of it, noise included, {s.said}" for s in shapes[:2]]
        hidden = ["structure that the held-out transitions do not show"]
        return [*said, *away] or [_louder(part) for part in loud(r)] or hidden
    beyond = loud(r)
    shapes = strongest(beyond, over, inputs)
    return (
        [*(_described(s) for s in shapes[:3]), *away]
        if beyond
        else [f"consistent with noise in one step{'; ' if away else ''}{''.join(away)}"]
    )


def loud(r: TraceResult) -> list[Component]:
    """Components of the one-step residual that exceed the noise on the held-out data."""
    parts = components(r.nominal, r.held, r.before.one_step, r.after.one_step, r.floor[0])
    return [p for p in parts if float(rms(p.before)) > ABOVE_NOISE * p.floor]


def _described(shape: Shape) -> str:
    """One line on a component of the residual and the variable that it follows."""
    follows = f"{_percent(shape.share)} of that {shape.said}" if shape.share > FOLLOWED else "it follows no single variable"
    return f"{_louder(shape.component)}; {follows}"


def _louder(part: Component) -> str:
    return f"{part.said}: {float(rms(part.before)) / max(part.floor, 1e-300):.3g} times the noise in one step"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _away(r: TraceResult, ends: Array, least: float) -> str:
    """State with the largest rollout error over noise, from errors (m, nx); empty if that ratio is at most `least`."""
    if not len(ends):
        return ""
    ratio = rms(ends) / r.floor[1].clip(1e-300)
    worst = int(ratio.argmax())
    usual = np.sort(np.abs(ends[:, worst]))[: max(1, round(USUAL * len(ends)))]  # a few outliers are counted elsewhere
    if min(ratio[worst], float(np.sqrt(np.mean(usual**2))) / max(float(r.floor[1][worst]), 1e-300)) <= least:
        return ""
    return f"prediction error of {r.nominal.states[worst]} after {r.horizon_s:.4g} s: {float(ratio[worst]):.3g} times the noise"


def _table(r: TraceResult) -> list[str]:
    """Table of errors: one line per state, and one in degrees for an angle. Without a new effect, one column instead of two."""
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
    kind = "independent samples" if independent else "transitions; descriptive only, no confidence statement"
    now = f"{before['radius']:.4g} {ARROW} {after['radius']:.4g}" if r.effects else f"{before['radius']:.4g}"
    lines = [f"{now}, the largest of {before['n']} {kind}"]
    if "hold_radius" in before:
        now = f"{before['hold_radius']:.4g} {ARROW} {after['hold_radius']:.4g}" if r.effects else f"{before['hold_radius']:.4g}"
        lines.append(f"{now} after {before['hold_periods']} held periods")
    return lines


def _shown(r: TraceResult) -> tuple[str, ...]:
    """Tokens on which the remaining residual depends significantly."""
    return tuple(token for token in r.depends_on if token not in {*r.may_depend_on, *r.any_shape_of})


def _remaining(r: TraceResult) -> list[str]:
    """Remaining structure: significant, then less certain."""
    check = ": check the effect" if r.effects else ""
    caveat = [f"less certain: something may depend on {', '.join(r.may_depend_on)}{check}"]
    return [*_significant(r), *(caveat if r.may_depend_on else [])]


def _significant(r: TraceResult) -> list[str]:
    """Remaining structure that is significant."""
    away = _away(r, r.after.ends, FAR_OFF)
    if not _shown(r):
        if r.verdict == "unexplained":
            return ["structure; the signals that it depends on could not be identified"]
        some = _away(r, r.after.ends, SLIGHTLY_OFF)
        noise = f"none above noise in one step; {some}" if some else "none above noise"
        return [f"not predictable from inputs and states: {away}" if away else noise]
    if _shown(r) == ("noise",):
        whatever = "" if r.may_depend_on else ", independent of the inputs"
        return [f"coloured noise: correlated in time{whatever}", *([away] if away else [])]
    percent = f"{100.0 * r.share_left:.0f} %" if r.share_left >= 0.01 else "under 1 %"
    much = f" ({percent} of what the model lacks)" if r.effects else ""
    lines = [f"structure{much} that depends on {', '.join(_shown(r))}"]
    return [*lines, "--report FILE.html plots it"] if r.verdict == "unexplained" else lines


def _faults(r: TraceResult) -> Iterator[str]:
    """One line for each interval and kind, with all channels, and one for what several segments share."""
    loud = sorted((f for f in r.faults if f.kind != "dropout" and not f.segment), key=lambda f: (f.from_s, f.to_s, f.kind))
    grouped = [(key, [f.channel for f in same]) for key, same in groupby(loud, key=lambda f: (f.from_s, f.to_s, f.kind))]
    found = [f"{kind} of {_channels(channels)} {_when(begin, end)}" for (begin, end, kind), channels in grouped]
    found += _in_segments([f for f in r.faults if f.kind != "dropout" and f.segment])
    yield from found[:LISTED]
    if len(found) > LISTED:
        yield f"and {len(found) - LISTED} more (all of them: --json)"
    silent = [f for f in r.faults if f.kind == "dropout"]
    if silent:
        yield f"{len(silent)} dropout{'s' if len(silent) > 1 else ''}, the longest {max(f.to_s - f.from_s for f in silent):.3g} s"
    if any(f.kind != "late" for f in r.faults):
        yield "affected samples are excluded"


def _in_segments(faults: Sequence[Fault]) -> list[str]:
    """Faults of recordings whose runs have names."""
    at: dict[tuple[str, float, float, str], list[str]] = {}
    for f in faults:
        at.setdefault((f.segment, f.from_s, f.to_s, f.kind), []).append(f.channel)
    alike: dict[str, list[tuple[str, float, float]]] = {}
    for (segment, begin, end, kind), channels in at.items():
        alike.setdefault(f"{kind} of {_channels(channels)}", []).append((segment, begin, end))
    lines = []
    for what, places in alike.items():
        names = list(dict.fromkeys(segment for segment, _, _ in places))
        if len(names) == 1:
            lines += [f"{what} in segment {segment} {_when(begin, end)}" for segment, begin, end in places]
            continue
        more = f" and {len(names) - SEGMENTS} more (all of them: --json)" if len(names) > SEGMENTS else ""
        lines.append(f"{what} in segments {', '.join(names[:SEGMENTS])}{more}")
    return lines


def _channels(channels: Sequence[str]) -> str:
    return ", ".join("all" if c == "*" else c for c in channels)


def _when(begin: float, end: float) -> str:
    return f"at {begin:.3f} s" if end == begin else f"from {begin:.3f} to {end:.3f} s"


def _unseen(r: TraceResult) -> list[str]:
    """Effects that these data could not have shown."""
    blind = [f"{name}({channel})" for name, channel in r.blind]
    if not blind or r.verdict not in {"none", "traced"}:
        return []
    more = f" and {len(blind) - LISTED} more" if len(blind) > LISTED else ""
    return [f"{', '.join(blind[:LISTED])}{more}: not detectable on this data (--suggest FILE.csv writes inputs that excite them)"]


def _data(r: TraceResult) -> list[str]:
    runs = len({int(run) for run in r.held.steps.run}) if r.held.data.source != r.source else len(r.held.data.runs)
    on = "on the model's step " if r.nominal.dt == r.spec.dt else ""
    lines = [f"{r.n_rows} rows in {runs} run{'s' if runs > 1 else ''}, {on}as recorded", *_assumed(r)]
    lines += list(r.done_to_data)
    if r.outliers:
        lines.append(f"{r.outliers} outlier{'' if r.outliers == 1 else 's'} down-weighted")
    lines.append(f"fitted on {r.n_fit} transitions, evaluated on {len(r.held.steps)} held-out ones")
    return lines


def _assumed(r: TraceResult) -> list[str]:
    """Parameters with default values: a wrong default, such as a wheel base, is traced as a gain."""
    model, said = r.nominal.nominal, r.nominal.spec.parameters
    unsaid = {} if isinstance(model.shared, FileModel) else {k: v for k, v in model.parameters.items() if k not in said}
    if not unsaid:
        return []
    numbers = ", ".join(f"{name} = {value:g}" for name, value in unsaid.items())
    return [f"default parameters of the model: {numbers} (--param {next(iter(unsaid))}=... for another value)"]


def labelled(label: str, lines: Sequence[str]) -> list[str]:
    """Lines next to a label, wrapped at words."""
    fitting = [piece for line in lines for piece in _wrapped(line)]
    return [f"{label if i == 0 else '':<{LABEL}}{line}" for i, line in enumerate(fitting)]


def _wrapped(text: str) -> list[str]:
    """Wrap at words, to the width next to a label."""
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > WIDTH - LABEL:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}" if line else word
    return [*lines, line] if line else lines
