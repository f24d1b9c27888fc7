"""Small figures of a trace, to stand side by side: before in orange, after in blue, on one scale.

Points outside of a frame (the few that lie far from all others) are drawn as triangles at its edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from s2r_runtime.report.plots import BLUE, GREEN, GRID, INK, ORANGE, QUIET, RED, SOFT, Array, figure, svg
from s2r_runtime.trace.diagnostics.residual_plots import Binned, Component, Shape, Variable, binned
from s2r_runtime.trace.reporting.figures import Correlated, OverTime, Stretch, envelope, spread

WIDTH, HEIGHT = 3.2, 2.2
"""Of a small figure, inches: at 300 pixels its words are as large as those of the page's captions."""

BROAD = 10.5

FRAMED, MARGIN = 0.998, 1.2
"""Share of the points that a frame shows, with a margin."""

SIGMAS = 1.96

SILENT = 8.0
"""Usual distances between the values of a curve from which on it is broken."""

POINTS = 500
"""Of a scatter: enough to see a cloud's shape, and forty of them stay a page."""

NEAR = 12.0
"""Half widths of an interval within which the value of no effect is drawn beside it."""

APART = 0.15
"""Means farther apart than this share of the axis are not joined."""


def shown_as(unit: str, largest: float) -> tuple[float, str]:
    """Factor and unit in which a quantity is drawn: degrees for radians, thousandths where all of it is small."""
    if unit == "rad":
        return math.degrees(1.0), "deg"
    if unit in {"m", "m/s", "m/s²"} and 0.0 < largest < 0.05:
        return 1000.0, f"m{unit}"
    return 1.0, unit


def label(name: str, unit: str) -> str:
    """`v (m/s)`."""
    return f"{name} ({unit})" if unit else name


def against(part: Component, over: Variable, *, changed: bool) -> str:
    """A component of the residual against a variable: points, and means over bins with their 95 % intervals."""
    fig, (ax,) = figure(WIDTH, HEIGHT)
    fx, ux = shown_as(over.unit if over.unit == "rad" else "", 0.0) if over.unit == "rad" else (1.0, over.unit)
    limit = _frame(part.before, part.after)
    fy, uy = shown_as(part.unit, limit)
    rows = spread(POINTS, part.before, part.after)
    series = [(part.before, ORANGE), (part.after, BLUE)] if changed else [(part.after, BLUE)]
    for values, colour in series:
        _points(ax, fx * over.values[rows], fy * values[rows], fy * limit, colour)
    for values, colour in series:
        bins = binned(over.values, values)
        if bins is not None:
            _means(ax, bins, fx, fy, colour)
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    ax.set_ylim(-fy * limit, fy * limit)
    ax.set_xlabel(label(over.name, ux))
    ax.set_ylabel(uy)
    return svg(fig, f"residual of {part.name} against {over.name}")


OVER_TIME = (0.085, 0.23, 0.905, 0.66)
"""Of residuals over time in shares of the figure: left, bottom, width, height. Room for numbers and a fault's word."""


def over_time(part: Component, all_of_it: OverTime, faults: Sequence[tuple[float, float, str]], *, changed: bool) -> str:
    """A component over all of the recording; what was held out shaded, faults of measurement in red."""
    fig, (ax,) = figure(BROAD, 2.1)
    ax.set_position(OVER_TIME)  # one stands below the other: the same time must stand at the same place, however wide the numbers are
    limit = _frame(part.before, part.after)
    fy, uy = shown_as(part.unit, limit)
    for begin, end in all_of_it.held_out:
        ax.axvspan(begin, end, color=GRID, linewidth=0, zorder=0.2)
    for values, colour in [(part.before, ORANGE), (part.after, BLUE)] if changed else [(part.after, BLUE)]:
        rows = envelope(all_of_it.t, values)
        t, e = all_of_it.t[rows], np.clip(fy * values[rows], -fy * limit, fy * limit)
        far = np.flatnonzero(np.diff(t) > SILENT * float(np.median(np.diff(t)))) + 1
        ax.plot(np.insert(t, far, np.nan), np.insert(e, far, np.nan), color=colour, linewidth=0.6)
    ax.set_ylim(-fy * limit, fy * limit)
    _mark_faults(ax, faults)
    ax.set_xlabel("s")
    ax.set_ylabel(label(part.name, uy))
    return svg(fig, f"residual of {part.name} over time")


def _mark_faults(ax: Any, faults: Sequence[tuple[float, float, str]]) -> None:
    """Spans in red, a brief one as a line; kinds above the frame where there is room for the words."""
    low, high = ax.get_xlim()
    last = -math.inf
    for begin, end, kind in sorted(faults):
        ax.axvspan(begin, end, color=RED, alpha=0.18, linewidth=0)
        ax.axvline(begin, color=RED, linewidth=0.9)
        if begin - last > 0.09 * (high - low):
            ax.text(begin, 1.02, kind, color=RED, fontsize=8, transform=ax.get_xaxis_transform())
            last = begin
    ax.set_xlim(low, high)


def correlation(name: str, c: Correlated, *, changed: bool) -> str:
    """Autocorrelation with what noise alone would show (95 %)."""
    fig, (ax,) = figure(WIDTH, HEIGHT)
    ax.fill_between(c.lag, c.expected - c.band, c.expected + c.band, color=QUIET, linewidth=0, alpha=0.8)
    for values, colour in [(c.before, ORANGE), (c.after, BLUE)] if changed else [(c.after, BLUE)]:
        ax.plot(c.lag, values, color=colour, linewidth=1.1, marker=".", markersize=3)
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    ax.set_ylim(min(-0.7, 1.05 * float(np.min([c.before, c.after]))), 1.02)
    ax.set_xlabel("lag (steps)")
    ax.set_ylabel(name)
    return svg(fig, f"autocorrelation of the residual of {name}")


def rollout(stretch: Stretch, column: int, name: str, unit: str, *, changed: bool) -> str:
    """A state over a stretch: measured, and foretold from each start; the rollout that it is about shaded."""
    fig, (ax,) = figure(WIDTH, HEIGHT)
    curves = [stretch.measured[:, column], stretch.before[:, column], stretch.after[:, column]]
    factor, unit = shown_as(unit, 1.0)
    if unit == "deg":  # angles are unwrapped: begin within a turn
        turns = math.tau * round(float(curves[0][0]) / math.tau)
        curves = [c - turns for c in curves]
    begin, end = _about(stretch)
    ax.axvspan(stretch.t[begin], stretch.t[end], color=GRID, linewidth=0, zorder=0.2)
    _broken(ax, stretch, stretch.t, factor * curves[0], factor * curves[1], ORANGE if changed else BLUE)
    if changed:
        _broken(ax, stretch, stretch.t, factor * curves[0], factor * curves[2], BLUE)
    ax.plot(stretch.t, factor * curves[0], color=INK, linewidth=0.9)
    ax.plot(stretch.t[stretch.starts], factor * curves[0][stretch.starts], ".", color=INK, markersize=5)
    ax.set_xlabel("s")
    ax.set_ylabel(label(name, unit))
    return svg(fig, f"rollouts of {name} against measurement, {stretch.said}")


def path(stretch: Stretch, x: int, y: int, *, changed: bool) -> str:
    """The same stretch from above."""
    fig, (ax,) = figure(WIDTH, HEIGHT)
    series = [(stretch.before, ORANGE), (stretch.after, BLUE)] if changed else [(stretch.after, BLUE)]
    for curve, colour in series:
        _broken(ax, stretch, curve[:, x], stretch.measured[:, y], curve[:, y], colour, stretch.measured[:, x])
    ax.plot(stretch.measured[:, x], stretch.measured[:, y], color=INK, linewidth=0.9)
    ax.plot(stretch.measured[stretch.starts, x], stretch.measured[stretch.starts, y], ".", color=INK, markersize=5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    return svg(fig, f"path, {stretch.said}")


def _about(stretch: Stretch) -> tuple[int, int]:
    ends = [*stretch.starts[1:].tolist(), len(stretch.t) - 1]
    return int(stretch.starts[stretch.about]), int(ends[stretch.about])


def _broken(ax: Any, stretch: Stretch, x: Array, measured: Array, curve: Array, colour: str, measured_x: Array | None = None) -> None:
    """A curve that begins anew at the measurement at each start."""
    ends = [*stretch.starts[1:].tolist(), len(curve) - 1]
    for begin, end in zip(stretch.starts.tolist(), ends, strict=True):
        xs = x[begin : end + 1].copy()
        if measured_x is not None:
            xs[0] = measured_x[begin]
        ax.plot(xs, np.append(measured[begin], curve[begin + 1 : end + 1]), color=colour, linewidth=2.0)


def interval(name: str, value: float, low: float | None, high: float | None, unit: str, neutral: float | None) -> str:
    """A parameter's 95 % interval; `none` marks the value at which there would be no effect, if it lies near."""
    fig, (ax,) = figure(WIDTH, 1.0)
    ends = [v for v in (low, high) if v is not None and math.isfinite(v) and abs(v) < 1e5]
    reach = max([abs(v - value) for v in ends] + [1e-4 * abs(value), 1e-9])
    if neutral is not None and abs(neutral - value) < NEAR * reach:
        reach = max(reach, abs(neutral - value))
        ax.axvline(neutral, color=SOFT, linewidth=1.2, linestyle=":")
        ax.text(neutral, 1.0, "none", color=SOFT, fontsize=8, ha="center", va="bottom", transform=ax.get_xaxis_transform())
    if ends:
        left, right = (low if low in ends else value - 1.3 * reach), (high if high in ends else value + 1.3 * reach)
        ax.plot([left, right], [0.0, 0.0], color=BLUE, linewidth=3.0, solid_capstyle="butt")
    ax.plot([value], [0.0], "o", color=BLUE, markersize=5)
    ax.set_xlim(value - 1.3 * reach, value + 1.3 * reach)
    ax.set_ylim(-1.0, 1.0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.locator_params(axis="x", nbins=4)
    ax.set_xlabel(label(name, "" if unit == "-" else unit))
    return svg(fig, f"{name}: {value:.4g} {unit}, 95 % from {low} to {high}")


def shape(s: Shape, over: Variable) -> str:
    """What is left of a component, against what it depends on: means over bins, 95 %."""
    fig, (ax,) = figure(WIDTH, HEIGHT)
    part = s.component
    bins = binned(over.values, part.after, None if s.per is None else s.per.values)
    fx, ux = shown_as("rad", 0.0) if over.unit == "rad" else (1.0, over.unit)
    if bins is not None:
        largest = float(np.max(np.abs(bins.mean)))
        fy, uy = shown_as(part.unit, largest)
        _means(ax, bins, fx, fy, BLUE)
        if s.per is not None:
            uy = f"{uy} per {s.per.unit or 'unit'} of {s.per.name}"
        ax.set_ylabel(label(part.name, uy))
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    ax.set_xlabel(label(over.name, ux))
    return svg(fig, f"what is left of {part.name} against {over.name}")


def field(x: Array, y: Array, push_x: Array, push_y: Array, unit: str) -> str:
    """Mean residual where the robot was: arrows along the world's axes."""
    fig, (ax,) = figure(WIDTH, 1.25 * HEIGHT)
    cells = 9
    ix, iy = (np.clip(((v - v.min()) / max(float(np.ptp(v)), 1e-12) * cells).astype(int), 0, cells - 1) for v in (x, y))
    place = ix * cells + iy
    n = np.bincount(place, minlength=cells * cells)
    there = n >= 8
    mean = [np.bincount(place, v, cells * cells)[there] / n[there] for v in (x, y, push_x, push_y)]
    if len(mean[0]):
        ax.quiver(*mean, color=BLUE, angles="xy", width=0.006)
        longest = float(np.max(np.hypot(mean[2], mean[3])))
        factor, unit = shown_as(unit, longest)
        ax.set_title(f"longest arrow: {factor * longest:.3g} {unit} a step", fontsize=9, loc="left")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    return svg(fig, "mean residual by place")


def sequence(t: Array, u: Array, names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Inputs over time, held."""
    drawn = []
    for j, name in enumerate(names):
        fig, (ax,) = figure(BROAD, 1.4)
        ax.step(t, u[:, j], where="post", color=GREEN, linewidth=1.0)
        ax.set_xlabel("s")
        ax.set_ylabel(label(name, units[j]))
        drawn.append(svg(fig, f"suggested {name} over time"))
    return drawn


def _frame(*values: Array) -> float:
    """Half the height of a frame around zero."""
    sizes = [float(np.quantile(np.abs(v), FRAMED)) if len(v) else 0.0 for v in values]
    return MARGIN * max(*sizes, 1e-12)


def _points(ax: Any, x: Array, y: Array, limit: float, colour: str) -> None:
    """Thousands of markers as vectors would weigh megabytes: they are an embedded picture, axes and words stay vectors."""
    inside = np.abs(y) <= limit
    ax.plot(x[inside], y[inside], ".", color=colour, markersize=3.4, alpha=0.45, markeredgewidth=0, rasterized=True)
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        out = ~inside & (np.sign(y) == sign)
        ax.plot(x[out], np.full(np.count_nonzero(out), sign * 0.96 * limit), marker, color=colour, markersize=3.5, rasterized=True)


def _means(ax: Any, bins: Binned, fx: float, fy: float, colour: str) -> None:
    """Means with their intervals; joined where they lie close. One path each: a page has hundreds."""
    x, y, e = fx * bins.middle, fy * bins.mean, SIGMAS * fy * bins.error
    gap = np.full(len(x), np.nan)
    ax.plot(np.column_stack([x, x, gap]).ravel(), np.column_stack([y - e, y + e, gap]).ravel(), color=colour, linewidth=1.0)
    far = np.flatnonzero(np.diff(x) > APART * float(np.ptp(x))) + 1
    ax.plot(np.insert(x, far, np.nan), np.insert(y, far, np.nan), color=colour, linewidth=1.2, marker="o", markersize=2.8)
