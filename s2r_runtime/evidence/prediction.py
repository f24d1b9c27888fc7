"""What a model predicts for transitions, each over a step of its own length and with the memory that the commands before it left.

    x1^ = f(x0, a; T)      a: the input that acts over [t0, t0 + T), from the effects on the commands before t0 and on u
    e   = x1 (-) x1^

A campaign's sample carries the commands before it (`Holds`): those of the approach and the stop, then u since the hold began. Effects with
memory begin at rest before the first of them. T is the sample's own length where the model steps exactly at any length (`any_step`), and
one step where it does not: such a sample is within 1 % of that (guarantee G7).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.recordings.transitions import Drive, Holds, Transitions

Array = NDArray[np.float64]


def residuals(model: ComposedModel, transitions: Transitions) -> Array:
    """(n, nx) e = x1 (-) f(x0, u). Samples without their past begin at rest; in a drive, memory is carried from its beginning.

    Raises ConfigError if the model's step gives something that isn't finite.
    """
    mean, end, lasts = acting_over(model, transitions)
    return _finite(model, model.difference(transitions.x1, model.advance(transitions.x0, mean, end, lasts)))


def acting_over(model: ComposedModel, transitions: Transitions) -> tuple[Array, Array, Array | None]:
    """What acts over each transition: (on average (n, nu), at its end (n, nu), how long it lasts (n,) s; None: one step each)."""
    tr, holds = transitions, transitions.holds
    if tr.drive is not None:
        return (*_driven(model, tr.drive), None)
    mean, end, _ = model.act(tr.u, model.at_rest(len(tr.u)))
    if holds is None:
        return mean, end, None
    if _remembers(model):
        mean, end = (table[:, -1] for table in acting(model, _rows_before(holds, tr.u), tr.u, holds.lasts[:, None]))
    return mean, end, holds.lasts if model.any_step else None


def hold_residuals(model: ComposedModel, transitions: Transitions) -> Array | None:
    """(n, nx) of the state after the hold; None if the transitions do not have it."""
    tr, holds, periods = transitions, transitions.holds, transitions.hold_periods
    if tr.held is None or periods <= 1:
        return None
    if holds is None:
        return _finite(model, model.difference(tr.held, model.hold(tr.x0, tr.u, periods)))
    steps = np.repeat(holds.ends[:, None] / periods, periods, axis=1)
    if _remembers(model):
        mean, end = acting(model, holds.past, tr.u, steps)
    else:
        once, at_end, _ = model.act(tr.u, model.at_rest(len(tr.u)))
        mean, end = (np.repeat(table[:, None], periods, axis=1) for table in (once, at_end))
    x = holds.start
    for k in range(periods):
        x = model.advance(x, mean[:, k], end[:, k], steps[:, k] if model.any_step else None)
    return _finite(model, model.difference(tr.held, x))


def acting(model: ComposedModel, past: Sequence[tuple[Array, Array]], u: Array, steps: Array) -> tuple[Array, Array]:
    """What acts over each of m steps of an input held after other commands: (on average, at the ends), (n, m, nu) each.

    past: of each of n, the commands before, from rest: how long each lasted (k,) s, and which (k, nu). u: (n, nu); steps: (n, m) s. Rows
    last about a step at most, like those that a simulation takes; and exactly one step, if the model is exact at that length only.
    """
    chain = [a for a in model.effects if a.effect.stage == "input" and not model.pushes(a)]
    parts, count = model.substeps, steps.shape[1]
    inputs, lasts, starts = [], [], []
    for (before, commands), held, own in zip(past, u, steps, strict=True):
        before, commands = before[before > 0.0], commands[before > 0.0]  # a command that another one replaced at once never acted
        pieces = np.maximum(1, np.rint(before / model.dt).astype(np.int64)) * parts
        rows = np.concatenate([np.repeat(before / pieces, pieces), np.repeat(own / parts, parts)])
        inputs.append(np.concatenate([np.repeat(commands, pieces, axis=0), np.tile(held, (count * parts, 1))]))
        lasts.append(rows if model.any_step else np.full(len(rows), model.dt / parts))
        starts.append(-float(np.sum(lasts[-1][: int(np.sum(pieces))])))
    laid = Inputs(inputs, model.dt / parts, starts, lasts if model.any_step else None).with_ends(model, chain)
    last = np.cumsum([len(rows) for rows in inputs])
    own_rows = last[:, None] - count * parts + np.arange(count * parts)
    mean, end = (table[own_rows].reshape(len(u), count, parts, -1) for table in laid)
    return mean.mean(axis=2), end[:, :, -1]


def _rows_before(holds: Holds, u: Array) -> list[tuple[Array, Array]]:
    """The commands before each sample: those before the hold, and u since it began."""
    return [
        (np.append(before, elapsed), np.vstack([commands, held])) if elapsed > 0.0 else (before, commands)
        for (before, commands), held, elapsed in zip(holds.past, u, holds.elapsed, strict=True)
    ]


def _remembers(model: ComposedModel) -> bool:
    """Whether what acts depends on the commands before."""
    inputs = (a for a in model.effects if a.effect.stage == "input")
    return any(a.effect.hidden(1, model.nominal, a.channel, model.dt, a.p).size for a in inputs)


def _driven(model: ComposedModel, drive: Drive) -> tuple[Array, Array]:
    """What acts over a drive's transitions, on average and at their ends, (n, nu) each: memory is carried along the drive."""
    mean = np.concatenate(drive.inputs)
    end = mean.copy()
    row = 0
    for stretch in drive.inputs if any(a.effect.stage == "input" for a in model.effects) else ():
        hidden = model.at_rest(1)
        for u in stretch:
            mean[row : row + 1], end[row : row + 1], hidden = model.act(u[None, :], hidden)
            row += 1
    return mean[drive.step], end[drive.step]


def _finite(model: ComposedModel, e: Array) -> Array:
    if not np.all(np.isfinite(e)):
        row, column = (int(i) for i in np.argwhere(~np.isfinite(e))[0])
        raise ConfigError(f"model {model.spec.name!r}: its step gives a {model.states[column]} that isn't finite, at transition {row}")
    return e
