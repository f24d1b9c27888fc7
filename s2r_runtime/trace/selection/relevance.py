"""Whether an effect is relevant: some rollout's rms error falls by the bar's share, on blocks of time that the parameters (all but those
blocks) never saw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.initial_states import begun, uncertain
from s2r_runtime.trace.estimation.parameters import values_of, with_values
from s2r_runtime.trace.estimation.prediction import acting, rms, rollout, rollout_starts, some_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, objective, sensitivities, under_noise
from s2r_runtime.trace.selection.scores import STRICT, Bar, name_of, names

Array = NDArray[np.float64]

BLOCKS = 5
"""Of the cross-validation."""

ALONE_TELLS = 0.95
"""Share of what tells a number from which on a block alone tells it: the others know it four times as poorly, or worse."""

BLIND = 4
"""Fits of which it is known how they foretell what they did not see."""

STARTS = 1200
"""Rollouts that relevance is judged on at most."""


def relevant(given: Problem, fit: Fit, base: Fit, horizon: int, bar: Bar = STRICT) -> bool:
    """Whether some state's error at one step, a quarter of the horizon or all of it falls by the bar's share, cross-validated."""
    known = (begun(given, fit), uncertain(fit, given.jacobian(fit.model))) if given.floor.axes else None
    edges = _edges(given, fit, base)
    blind = [_blind(given, f, edges, known) for f in (base, fit)]
    for steps in sorted({1, max(1, horizon // 4), horizon}):
        before, after = (one.errors(given, steps) for one in blind)
        if np.any(before > (1.0 + bar.share) * after):
            return True
    return False


@dataclass(frozen=True)
class _Blind:
    """A fit, each block of time under the model that has its parameters from the other ones. known: as `_held_out_errors`."""

    fit: Fit
    models: Sequence[ComposedModel]
    edges: Array
    known: tuple[Array | None, Array] | None
    found: dict[int, Array] = field(default_factory=dict)

    def errors(self, given: Problem, steps: int) -> Array:
        """(nx,) rms at the end of rollouts of so many steps."""
        if steps not in self.found:
            self.found[steps] = _held_out_errors(given, self.fit, self.models, self.edges, steps, self.known)
        return self.found[steps]


def _blind(given: Problem, fit: Fit, edges: Array, known: tuple[Array | None, Array] | None) -> _Blind:
    """The last ones are known: many candidates are held against one model, and one model against many that it could do without."""
    key = id(fit), edges.tobytes()
    found = given.blind.pop(key, None) if known is None else None
    if not isinstance(found, _Blind):
        found = _Blind(fit, _less_each_block(given, fit, edges), edges, known)
    if known is None:
        given.blind[key] = found
        while len(given.blind) > BLIND:
            given.blind.pop(next(iter(given.blind)))
    return found


def _held_out_errors(
    given: Problem, fit: Fit, models: Sequence[ComposedModel], edges: Array, horizon: int, known: tuple[Array | None, Array] | None
) -> Array:
    """(nx,) rms at the end of rollouts, in blocks of time between the edges, each under the model that has its parameters from the other
    blocks. known: where axes were whose speed was not measured (rows, nx), and its variances; else by what was measured.
    """
    starts = rollout_starts(given.data, horizon)
    starts = some_of(starts[np.isin(starts, given.steps.place)], horizon, STARTS)
    if not len(starts):
        return np.full(given.steps.y0.shape[1], np.nan)
    errors = []
    for block, model in enumerate(models):
        inside = starts[(starts >= edges[block]) & ((starts < edges[block + 1]) | (block == BLOCKS - 1))]
        if len(inside):
            begin = begun(given, under_noise(given, model, fit.noise)) if given.floor.axes else None
            errors.append(
                rollout(model, given.data, acting(model, given.data), inside, horizon, begun=begin, ends=known and known[0]).error
            )
    off = rms(np.concatenate(errors))
    return off if known is None else np.sqrt(off**2 + known[1])


def _edges(given: Problem, fit: Fit, base: Fit) -> Array:
    """(BLOCKS + 1,) of blocks of time, all of as many steps. Where one of these has nearly all that tells a new number (a wheel that was
    asked to turn once only), the others know nothing of it, and no block can be foretold: then half of what makes blocks alike is that. Not
    of what depends on time itself: of that, something that happens once shows nothing.
    """
    place, even = given.steps.place, np.linspace(0.0, 1.0, BLOCKS + 1)
    edges = np.quantile(place, even)
    there = names(base.model)
    effects = [fit.model.effects[slot.place] for slot in fit.free]
    new = tuple(s for s, a in zip(fit.free, effects, strict=True) if name_of(a) not in there and not getattr(a.effect, "timed", False))
    told = np.square(sensitivities(given, fit, fit.model, new)).reshape(*fit.z.shape, len(new)).sum(axis=1)
    told = told[:, told.sum(axis=0) > 0.0] / told.sum(axis=0)[told.sum(axis=0) > 0.0]
    block = _block(place, edges)
    if max((float(np.max(np.bincount(block, one, BLOCKS))) for one in told.T), default=0.0) <= ALONE_TELLS:
        return np.asarray(edges)
    share = np.cumsum(0.5 / len(place) + 0.5 * told.mean(axis=1))
    cut = np.minimum(np.searchsorted(share, even[1:-1]), len(place) - 1)
    return np.array([place[0], *place[cut], place[-1]], dtype=np.float64)


def _block(place: NDArray[np.int64], edges: Array) -> NDArray[np.int64]:
    """(n,) which block each step is in."""
    return np.clip(np.searchsorted(edges, place, side="right") - 1, 0, BLOCKS - 1)


def _less_each_block(given: Problem, fit: Fit, edges: Array) -> list[ComposedModel]:
    """The model refitted without each block, to first order."""
    free = fit.free
    if not free:
        return [fit.model] * BLOCKS
    z = objective(given, fit, fit.model)
    j = sensitivities(given, fit, fit.model, free)
    w = noises.weight(z).ravel()
    block = np.repeat(_block(given.steps.place, edges), z.shape[1])
    models = []
    for b in range(BLOCKS):
        rest = block != b
        jw = j[rest] * w[rest, None]
        normal = j[rest].T @ jw
        step = np.linalg.lstsq(normal + 1e-9 * np.diag(np.diag(normal)), jw.T @ z.ravel()[rest], rcond=1e-10)[0]
        models.append(with_values(fit.model, free, values_of(fit.model, free) - step) or fit.model)
    return models
