"""One recording: a world driven by a law or a controller, seen at its own stamps; as rows of a CSV with the truth beside it.

Stamps are whole parts of h. `rows`: where the state is measured; `orders`: where a command is issued (and acts until the next one).
"""

from __future__ import annotations

import csv
import gzip
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets.excitation import Controller
from trace_sets.noise import Noise
from trace_sets.plants import Numbers, Plant
from trace_sets.world import Moment, Start, World, wrapped

Array = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass
class Run:
    """One segment. t, y: (K,), (K, nx) what was measured; t_u, u: (M,), (M, nu) commands; starts: of rollouts for the ratio."""

    t: Array
    y: Array
    t_u: Array
    u: Array
    starts: list[Start] = field(default_factory=list)


def record(
    world: World,
    rows: Whole,
    orders: Whole,
    commands: Array | Controller,
    noise: Noise,
    x0: Numbers,
    rng: np.random.Generator,
    *,
    origin: float = 0.0,
    ahead: int = 0,
    rollouts: int = 30,
) -> Run:
    """Drives. commands: (M, nu) for the orders, or a controller on what was measured last. ahead: rows of a rollout (0: none are kept)."""
    last = int(rows[-1])
    errors = noise.errors(rng, len(rows))
    lines: list[Numbers] = [[] for _ in world.plant.inputs]
    moment = Moment(world, lines, list(x0))
    moment.origin = origin
    moment.wander = noise.pushes(rng, last // world.parts + 2, world.dt)
    at_row = {int(i): k for k, i in enumerate(rows)}
    orders = orders[orders <= last]
    at_order = {int(i): k for k, i in enumerate(orders)}
    events = sorted({*at_row, *at_order, last})
    begins = set(np.linspace(0, len(rows) - 1 - ahead, rollouts).astype(int).tolist()) if 0 < ahead < len(rows) - 1 else set()
    y: list[Numbers] = []
    issued: list[Numbers] = []
    kept: list[tuple[int, Moment]] = []
    held = [0.0] * len(lines)
    for place, i in enumerate(events):
        row = at_row.get(i)
        if row is not None:
            y.append(noise.rounded([a + b for a, b in zip(moment.read(), errors[row].tolist(), strict=True)]))
            if row in begins:
                kept.append((row, moment.copy()))
        order = at_order.get(i)
        if order is not None:
            held = commands(origin + i * world.h, y[-1] if y else list(x0)) if callable(commands) else commands[order].tolist()
            issued.append(held)
        if place + 1 < len(events):
            until = events[place + 1]
            for line, value in zip(lines, held, strict=True):
                line.extend([value] * (until - i))
            while moment.i < until:
                moment.part()
    starts = [Start(m, y[k], int(rows[k + ahead]), y[k + ahead]) for k, m in kept]
    return Run(origin + world.h * rows, np.array(y), origin + world.h * orders, np.array(issued).reshape(len(orders), len(lines)), starts)


@dataclass
class Recording:
    """What is written. together: state and command stand on one row where their stamps agree; unseen: states without a column."""

    plant: Plant
    runs: list[Run]
    digits: int = 6
    figures: int = 8
    together: bool = True
    wrap: bool = True
    unseen: tuple[str, ...] = ()

    def text(self) -> str:
        """The CSV."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        names = [*(n for n in self.plant.states if n not in self.unseen), *self.plant.inputs]
        many = len(self.runs) > 1
        writer.writerow([*(["segment"] if many else []), "t", *names])
        for number, run in enumerate(self.runs):
            for stamp, cells in self._rows(run):
                writer.writerow([*([f"r{number}"] if many else []), f"{stamp:.{self.digits}f}", *cells])
        return out.getvalue()

    def _rows(self, run: Run) -> list[tuple[float, list[str]]]:
        seen = [i for i, name in enumerate(self.plant.states) if name not in self.unseen]
        nx, nu = len(seen), len(self.plant.inputs)
        rows: dict[tuple[float, int], list[str]] = {}
        for stamp, y in zip(run.t.tolist(), run.y.tolist(), strict=True):
            values = [wrapped(v) if self.wrap and name == "theta" else v for name, v in zip(self.plant.states, y, strict=True)]
            rows[stamp, 0] = [*("" if np.isnan(values[i]) else f"{values[i]:.{self.figures}g}" for i in seen), *[""] * nu]
        for stamp, u in zip(run.t_u.tolist(), run.u.tolist(), strict=True):
            cells = [f"{v:.{self.figures}g}" for v in u]
            here = rows.get((stamp, 0)) if self.together else None
            if here is not None:
                here[nx:] = cells
            else:
                rows[stamp, 1] = [*[""] * nx, *cells]
        return [(stamp, cells) for (stamp, _), cells in sorted(rows.items())]


@dataclass
class TraceSet:
    """A recording with its truth. model: what the tracer is given (name, dt, parameters, effects as a model TOML has them).

    raw: a text that is no recording, for bad input; draft: from which the same robot can be driven again (not written).
    """

    family: str
    seed: int
    recording: Recording | None
    model: dict[str, Any]
    truth: dict[str, Any]
    raw: str | None = None
    draft: Any = field(default=None, repr=False)

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.family}-{self.seed:06d}"

    def write(self, folder: Path, *, packed: bool = False) -> tuple[Path, Path]:
        """NAME.csv (.gz) and NAME.truth.json; nothing in the first tells of the second."""
        text = self.raw if self.raw is not None else self.recording.text() if self.recording else ""
        data = folder / f"{self.name}.csv{'.gz' if packed else ''}"
        data.write_bytes(gzip.compress(text.encode(), 6, mtime=0) if packed else text.encode())
        beside = folder / f"{self.name}.truth.json"
        told = {"family": self.family, "seed": self.seed, "model": self.model, **self.truth}
        beside.write_text(json.dumps(told, indent=1, sort_keys=True, default=float) + "\n", encoding="utf-8")
        return data, beside
