"""Figures for the reports, as SVG text that stands inside a page. matplotlib (extra `report`), no window, no files."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError

Array = NDArray[np.float64]

INK, SOFT, BLUE, ORANGE, RED, GREEN = "#1b2330", "#8a94a3", "#2f6db3", "#d9822b", "#c23030", "#2b8a57"
GRID, QUIET = "#e7eaee", "#d0d5dc"
NAMED = {INK: "ink", SOFT: "faint", BLUE: "blue", ORANGE: "orange", RED: "bad", GREEN: "good", GRID: "grid", QUIET: "quiet"}
"""Colours by their names in the page's style sheet, which has others for dark windows."""

_LIGHTER = tuple(
    (re.compile(pattern, re.DOTALL), instead)
    for pattern, instead in (
        (r' id="(figure|axes|patch|line2d|text|legend|matplotlib\.axis|xtick|ytick|[A-Za-z]*Collection)_\d+"', ""),  # in every figure alike
        (r"<metadata>.*?</metadata>", ""),
        (r" font-family: [^;]*;", " font-family: sans-serif;"),
        (r' transform="rotate\(-0 [^"]*"', ""),
        (r"(?<=base64,)\s+", ""),
        (r">\s+<", "><"),
        (r"\s*\n\s*", " "),
    )
)
"""What makes matplotlib's SVG lighter, by half, without a difference that can be seen."""

_TAG, _FINE = re.compile(r"<[^>]*>"), re.compile(r"(\d\.\d\d)\d+")
"""Coordinates stand inside tags: hundredths of a point are enough there (and nowhere else)."""

RASTER_DPI = 100
"""Of clouds of points, which are pictures: as fine as they are shown."""

CAP_POINTS = 2000
"""More points than this a line are thinned: a page should stay a page."""


def figure(width: float = 7.2, height: float = 2.8, columns: int = 1) -> tuple[Any, list[Any]]:
    """A figure and its axes in one row, sizes in inches. Raises ConfigError if matplotlib is not installed."""
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError("plots need matplotlib: pip install 's2r-runtime[report]'") from None
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "s2r", "font.family": "sans-serif", "font.size": 9})
    mpl.rcParams.update({"text.color": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK})
    mpl.rcParams.update({"axes.formatter.useoffset": False})
    mpl.rcParams.update({"axes.edgecolor": SOFT, "axes.facecolor": "none", "figure.facecolor": "none", "savefig.facecolor": "none"})
    fig = Figure(figsize=(width, height), layout="constrained")
    axes = [fig.add_subplot(1, columns, 1 + i) for i in range(columns)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=INK, length=3)
        ax.grid(visible=True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
    return fig, axes


def svg(fig: Any, description: str) -> str:
    """The figure as an <svg> element with a description for readers who can't see it; the same figure gives the same text."""
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", dpi=RASTER_DPI, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    body = text[text.index("<svg") :]
    for pattern, instead in _LIGHTER:
        body = pattern.sub(instead, body)
    body = _TAG.sub(lambda tag: _FINE.sub(r"\1", tag.group()), body)
    for colour, name in NAMED.items():
        body = body.replace(f": {colour}", f": var(--{name})")
    label = description.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return re.sub(r"<svg ", f'<svg role="img" aria-label="{label}" ', body, count=1)


def histogram(values: Sequence[float] | Array, xlabel: str, lines: Mapping[str, tuple[float, str]], description: str) -> str:
    """Histogram with named vertical lines. lines: label -> (value, colour)."""
    fig, (ax,) = figure()
    data = np.asarray(values, dtype=np.float64)
    if len(data):
        ax.hist(data, bins=min(60, max(10, round(len(data) ** 0.5) * 2)), color=BLUE, alpha=0.75)
    for label, (value, colour) in lines.items():
        ax.axvline(value, color=colour, linewidth=1.6, label=label)
    if lines:
        ax.legend(frameon=False, fontsize=8)
    ax.set_xlabel(xlabel)
    ax.set_ylabel("count")
    return svg(fig, description)


def histograms(groups: Mapping[str, Sequence[float]], xlabel: str, line: float, description: str) -> str:
    """One histogram a group, side by side on one scale; `line`: the threshold."""
    names = list(groups) or ["none"]
    fig, axes = figure(columns=len(names))
    values = [v for group in groups.values() for v in group] or [0.0]
    low, high = min([*values, line]), max([*values, line])
    bins = np.linspace(low - 0.02 * (high - low + 1e-9), high + 0.02 * (high - low + 1e-9), 32)
    for ax, name in zip(axes, names, strict=True):
        ax.hist(groups.get(name, []), bins=bins, color=BLUE, alpha=0.75)
        ax.axvline(line, color=RED, linewidth=1.4)
        ax.set_title(name, fontsize=9, loc="left")
        ax.set_xlabel(xlabel)
    axes[0].set_ylabel("rollouts")
    return svg(fig, description)


def series(curves: Mapping[str, tuple[Array, Array, str]], xlabel: str, ylabel: str, description: str, *, log: bool = False) -> str:
    """Lines. curves: label -> (x, y, colour)."""
    fig, (ax,) = figure()
    for label, (x, y, colour) in curves.items():
        step = max(1, len(x) // CAP_POINTS)
        ax.plot(x[::step], y[::step], color=colour, linewidth=1.1, label=label)
    if log:
        ax.set_yscale("log")
    if curves:
        ax.legend(frameon=False, fontsize=8)
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    return svg(fig, description)


def scatter_pair(x: Array, before: Array, after: Array, xlabel: str, ylabel: str, description: str) -> str:
    """The same residual against a variable, before and after, on one scale."""
    fig, axes = figure(columns=2)
    limit = float(np.max(np.abs(np.concatenate([before, after, [1e-12]])))) * 1.05
    step = max(1, len(x) // CAP_POINTS)
    for ax, values, name in ((axes[0], before, "before"), (axes[1], after, "after")):
        # thousands of markers as vectors would weigh megabytes: the points are an embedded picture, axes and words stay vectors
        ax.plot(x[::step], values[::step], ".", color=BLUE, markersize=2, alpha=0.5, rasterized=True)
        ax.set_ylim(-limit, limit)
        ax.set_title(name, fontsize=9, loc="left")
        ax.set_xlabel(xlabel)
    axes[0].set_ylabel(ylabel)
    return svg(fig, description)


def timeline(
    spans: Sequence[tuple[float, float, str]],
    marks: Sequence[tuple[float, int, str]],
    colours: Mapping[str, tuple[str, str]],
    xlabel: str,
    description: str,
) -> str:
    """What held when. spans: (from, to, kind); marks: (when, number, colour); colours: kind -> (colour, label)."""
    fig, (ax,) = figure(height=1.9)
    ax.grid(visible=False)
    for kind, (colour, label) in colours.items():
        bars = [(begin, end - begin) for begin, end, what in spans if what == kind]
        ax.broken_barh(bars, (0.35, 0.4), color=colour, linewidth=0, label=label)
    last = {True: -np.inf, False: -np.inf}
    width = max((end for _, end, _ in spans), default=1.0) - min((begin for begin, _, _ in spans), default=0.0)
    for when, number, colour in marks:
        ax.plot([when, when], [0.28, 0.82], color=colour, linewidth=1.2)
        above = number % 2 == 1
        if when - last[above] > 0.018 * width:  # numbers that would lie on top of each other are left to the list
            ax.text(when, 0.9 if above else 0.16, str(number), color=colour, ha="center", va="center", fontsize=8)
            last[above] = when
    ax.set_ylim(0.0, 1.0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.legend(frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.25))
    ax.set_xlabel(xlabel)
    return svg(fig, description)


def path(x: Array, y: Array, allowed: NDArray[np.bool_], xlabel: str, ylabel: str, description: str) -> str:
    """Where the robot went: driven by the certified controller, and by anything else."""
    fig, (ax,) = figure(width=5.4, height=3.8)
    step = max(1, len(x) // CAP_POINTS)
    ax.plot(x[::step], y[::step], color=QUIET, linewidth=0.8, label="all of the run")
    masked = np.where(allowed, 1.0, np.nan)
    ax.plot((x * masked)[::step], (y * masked)[::step], color=GREEN, linewidth=1.8, label="certified controller")
    ax.set_aspect("equal")
    ax.legend(frameon=False, fontsize=8, loc="upper right")
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    return svg(fig, description)
