"""The page of `s2r trace --report`, with figures.

It answers in this order: what explains the residual, before and after; what is left, and its shape; rollouts against measurement; what was
left over, against everything it may depend on; over time, with the faults; autocorrelation; what was tried; what was done to the data.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from s2r_runtime.report import trace_plots as plots
from s2r_runtime.report.page import Page
from s2r_runtime.report.trace_section import add_trace
from s2r_runtime.trace.diagnostics.residual_plots import (
    Shape,
    clearest,
    components,
    derived,
    has_pose,
    of_tokens,
    shape_of,
    variables,
    world,
)
from s2r_runtime.trace.reporting.figures import correlations, over_time, stretches
from s2r_runtime.trace.reporting.text import FOLLOWED, loud

if TYPE_CHECKING:
    from s2r_runtime.trace.reporting.result import TraceResult

CANDIDATES = 12
"""Candidates that are listed."""

SHOWN = 0.05
"""Share of what is left that a shape accounts for at least, to be drawn without a word."""

BEFORE_AFTER = (("before", "orange"), ("after", "blue"))


def trace_page(result: TraceResult, suggested: Any = None) -> str:
    """The page of `s2r trace --report`. suggested: the sequence of inputs that --suggest wrote, if it did."""
    r = result
    model = r.nominal.spec.name.rsplit("/", 1)[-1]
    page = Page("Trace of a residual", f"{r.source} · {r.n_rows} rows · {model}, step {r.nominal.dt:.4g} s", wide=True)
    changed = r.model.effects != r.nominal.effects
    trace = r.to_json()
    add_trace(page, trace)
    _intervals(page, r)
    _what_is_left(page, r)
    _rollouts(page, r, changed)
    _against(page, r, changed)
    _over_time(page, r, changed)
    _correlation(page, r, changed)
    _candidates(page, trace)
    _could_see(page, trace)
    _suggested(page, r, suggested)
    _data(page, r)
    return page.html()


def _intervals(page: Page, r: TraceResult) -> None:
    """Each fitted parameter with its interval; the value at which there would be no effect is marked where it is near."""
    drawn = []
    for effect, place in zip(r.effects, [a for a in r.model.effects if a not in r.nominal.effects], strict=False):
        for p in place.effect.parameters:
            value, low, high, unit = effect.parameters.get(p.name, (None, None, None, ""))
            if isinstance(value, float):
                low, high = (v if isinstance(v, float) else None for v in (low, high))
                none = "" if p.neutral is None else f"; {p.neutral:g} would be no effect"
                drawn.append((plots.interval(p.name, value, low, high, unit, p.neutral), f"{effect.name} on {effect.channel}{none}"))
    if drawn:
        page.heading("Parameters and their 95 % intervals", 3)
        page.panels(drawn)


def _what_is_left(page: Page, r: TraceResult) -> None:
    """Its shape against what it depends on. It gets no name."""
    tokens = [t for t in r.depends_on if t != "noise" and t not in r.any_shape_of]
    if not tokens:
        return
    sure = not {*tokens} <= {*r.may_depend_on}
    page.heading(f"What is left, and what it {'depends' if sure else 'may depend'} on")
    why = (
        "has no name, because no effect in the library has this shape."
        if sure
        else "is so small that no rollout shows it, or was there for a short while only."
    )
    page.text(
        "Means of the one-step residual on held-out data in bins of what it depends on, with their 95 % intervals. The shape is shown; it "
        + why
    )
    # what is left went into the estimate of the noise too: shares are of all that is left, noise included
    steps = [r.before.one_step, r.after.one_step, 0.0 * r.floor[0]]
    parts, axes = components(r.nominal, r.held, *steps), world(r.nominal, *steps)
    over = variables(r.nominal, r.held)
    inputs = over[: len(r.nominal.inputs)]
    drawn, faint = [], []
    for token, wanted in of_tokens(tokens, [*over, *derived(r.nominal, r.held)]):
        shapes = sorted((shape_of(p, wanted, inputs, after=True) for p in [*parts, *axes]), key=lambda s: -s.share)
        drawn += [(plots.shape(s, s.variable), _shape_said(token, s)) for s in shapes[:3] if s.variable is not None and s.share > SHOWN]
        if wanted:
            faint.append((token, clearest([*parts, *axes], wanted)))
        if axes and any(v.name == "x" for v in wanted):
            x, y = (r.held.steps.y0[:, r.nominal.states.index(name)] for name in ("x", "y"))
            drawn.append((plots.field(x, y, axes[0].after, axes[1].after, axes[0].unit), "position: mean residual by place"))
    if not drawn and faint:
        page.text("In single steps of what was held out it hardly stands out of the noise: what was fitted, or rollouts, show it.", "soft")
        drawn = [(plots.shape(s, s.variable), _shape_said(token, s)) for token, s in faint if s.variable is not None]
    if drawn:
        page.panels(drawn)
    if "constant" in tokens or not drawn:
        means = [
            (p.name, f"{float(np.mean(p.after)):.3g} ± {1.96 * float(np.std(p.after)) / math.sqrt(len(p.after)):.2g} {p.unit}")
            for p in [*parts, *axes]
        ]
        page.table(("mean of what is left, a step", ""), means)


def _shape_said(token: str, s: Shape) -> str:
    part = "position" if s.component.name in {"along", "across", "x", "y"} else s.component.name
    where = f" {s.component.said}" if s.component.said != part else ""
    return f"{token}: what is left of {part}{where} {s.said} ({100.0 * s.share:.0f} % of its square, noise included)"


def _rollouts(page: Page, r: TraceResult, changed: bool) -> None:
    found = stretches(r)
    if not found:
        return
    units: dict[str, str] = getattr(r.nominal.nominal, "units", {})
    page.heading("Rollouts against measurement")
    page.text(
        f"Rollouts of {r.horizon_s:.4g} s, each begun at the measured state (dots), on held-out data. Grey: the one that is meant.", "soft"
    )
    page.key([("measured", "ink"), *(BEFORE_AFTER if changed else [("the model", "blue")])])
    for stretch in found:
        page.heading(f"{stretch.said.capitalize()}, from {stretch.t[stretch.starts[stretch.about]]:.2f} s on", 3)
        panels = [plots.rollout(stretch, i, s, units.get(s, ""), changed=changed) for i, s in enumerate(r.nominal.states)]
        if has_pose(r.nominal):
            panels.insert(0, plots.path(stretch, r.nominal.states.index("x"), r.nominal.states.index("y"), changed=changed))
        page.panels((svg, "") for svg in panels)


def _against(page: Page, r: TraceResult, changed: bool) -> None:
    page.heading("One-step residual against what it may depend on")
    page.text(
        "Held-out data: points, and means over bins with their 95 % intervals. Means that stay at zero are noise. Triangles at an edge:"
        " points beyond it.",
        "soft",
    )
    if has_pose(r.nominal):
        page.text("Along: ahead of where the model had it, in the direction of the heading. Across: to the left of it.", "soft")
    page.key(BEFORE_AFTER if changed else [("residual", "blue")])
    over, more = variables(r.nominal, r.held), derived(r.nominal, r.held)
    # within the noise, and beside measurements that are wrong, something accounts for most of next to nothing: that is no finding
    told = set() if r.verdict in {"none", "sensor_fault"} else {part.name for part in loud(r)}
    for part in components(r.nominal, r.held, r.before.one_step, r.after.one_step, r.floor[0]):
        s = shape_of(part, [*over, *more], over[: len(r.nominal.inputs)])
        page.heading(f"Residual of {part.name}" if part.name in r.nominal.states else f"Residual {part.said}", 3)
        if part.name in told and s.share > FOLLOWED:
            page.text(f"{'Before: ' if changed else ''}{100.0 * s.share:.0f} % of what is not noise {s.said}.", "soft")
        drawn = [*over, *([s.variable] if s.variable in more else [])]
        page.panels((plots.against(part, v, changed=changed), "") for v in drawn if v is not None)


def _over_time(page: Page, r: TraceResult, changed: bool) -> None:
    page.heading("Over time")
    everything = over_time(r)
    same = r.held.data.source == r.source
    wrong = [f for f in r.faults if f.kind != "late"]
    note = "Grey: held out." if everything.held_out else "All of it is held out: the fit was made on another recording."
    page.text(note + (" Red: faults of measurement; affected samples are excluded." if wrong and same else ""), "soft")
    page.key(BEFORE_AFTER if changed else [("residual", "blue")])
    for part in everything.parts:
        faults = (
            [(f.from_s, f.to_s, f.kind) for f in wrong if f.channel in {part.name, "*"} or part.name in {"along", "across"}] if same else []
        )
        page.broad(plots.over_time(part, everything, faults, changed=changed), "")


def _correlation(page: Page, r: TraceResult, changed: bool) -> None:
    page.heading("Autocorrelation")
    page.text(
        "Of the one-step residual on held-out data. Grey: where 95 % of the values of noise alone would lie. Measurement noise enters two"
        " neighbouring residuals with opposite signs: up to -0.5 at lag 1.",
        "soft",
    )
    page.key(BEFORE_AFTER if changed else [("residual", "blue")])
    parts = components(r.nominal, r.held, r.before.one_step, r.after.one_step, r.floor[0])
    page.panels((plots.correlation(name, c, changed=changed), "") for name, c in correlations(r, parts))


def _candidates(page: Page, trace: dict[str, Any]) -> None:
    if not trace["candidates"]:
        return
    page.heading("What was tried")
    page.text(
        "Score of each effect alone on the given model: nats of likelihood gained, less the price of its parameters. Green: found.", "soft"
    )
    found = {(e["name"], e["channel"]) for e in trace["effects"]}
    rivals = {(e["name"], e["channel"]) for e in trace["ambiguous_with"] if not e.get("same_thing")}
    rows = []
    for c in trace["candidates"][:CANDIDATES]:
        key = c["name"], c["channel"]
        colour = "good" if key in found else "orange" if key in rivals else "quiet"
        if c["score"] <= 0.0 and colour == "quiet":
            continue
        rows.append((f"{c['name']} on {c['channel']}", c["score"], f"{c['score']:.1f}", colour))
    if rows:
        page.bars(rows)
    else:
        page.text("No effect of the library gains anything.")


def _could_see(page: Page, trace: dict[str, Any]) -> None:
    rows = trace.get("could_see")
    if not rows:
        return
    page.heading("What these data could have shown")
    page.text(
        "The smallest size (away from no effect) at which each further effect would have been found. What was not found may still be"
        " there, smaller.",
        "soft",
    )
    told = [(v["name"], v["channel"], _size(v)) for v in sorted(rows, key=lambda v: (v["size"] is not None, v["name"], v["channel"]))]
    blind = sum(1 for v in rows if v["size"] is None)
    page.folded(f"{len(rows)} effects" + (f", {blind} of them not at all" if blind else ""), ("effect", "acts on", "from"), told)


def _size(v: dict[str, Any]) -> str:
    unit = "" if v["unit"] == "-" else f" {v['unit']}"
    return "not at all: these inputs do not show it" if v["size"] is None else f"{v['parameter']} {v['size']:.2g}{unit}"


def _suggested(page: Page, r: TraceResult, suggested: Any) -> None:
    if suggested is None:
        return
    units: dict[str, str] = getattr(r.nominal.nominal, "units", {})
    page.heading("What to drive next")
    for line in suggested.lines():
        page.text(f"{line[0].upper()}{line[1:]}.")
    if suggested.u is not None:
        t = suggested.dt * np.arange(len(suggested.u), dtype=np.float64)
        for svg in plots.sequence(t, suggested.u, r.nominal.inputs, [units.get(name, "") for name in r.nominal.inputs]):
            page.broad(svg, "")


def _data(page: Page, r: TraceResult) -> None:
    page.heading("Data")
    page.text(f"{r.n_rows} rows. Fitted on {r.n_fit} transitions, evaluated on {len(r.held.steps)} held-out ones.")
    for line in r.done_to_data:
        page.text(line)
    if r.outliers:
        page.text(f"{r.outliers} outlier{'' if r.outliers == 1 else 's'} down-weighted.")
