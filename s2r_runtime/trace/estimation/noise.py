"""Noise of a residual: states are measured, so it enters twice, and neighbours are correlated.

    r_k = y_{k+1} (-) f(y_k) = effect + w_k + e_{k+1} - F_k e_k,      w ~ (0, Q),  e ~ (0, R),  Q and R diagonal
    cov(r_k, r_k) = Q + R + F_k R F_k^T,    cov(r_k, r_{k-1}) = -F_k R   where step k begins where k-1 ended, else 0

(Q plus p_k p_k^T where noise of its own `push`es along p_k, `body_frame_noise`.)

S = L L^T is banded (2 nx - 1 below the diagonal); whitened residual z = L^-1 r. Q and R maximise, state by state, the likelihood of
that state's residual alone (tridiagonal), the others' measurement noise in it taken from the round before: consistent, and a
thousand times cheaper than the whole likelihood. Where that of others hides a state's own (a precise position beside a loud speed), the
whole one is maximised (`together`). What remains correlated in z is taken up by an autoregression per state.

Errors have tails: a value of z has the density (1 - TAIL) N(0, 1) + TAIL N(0, WIDE^2), so one wild value costs a few nats, not z^2/2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation.innovation_outliers import are_shocks
from s2r_runtime.trace.estimation.speed_noise import of_axis
from s2r_runtime.trace.estimation.state_noise import of_state

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TAIL, WIDE = 0.01, 8.0
"""Share and size of wild errors in the density above. One such error then costs about log(WIDE / TAIL) = 7 nats."""

OFTEN = 0.01
"""Share of steps that are wild in some state, from which on shocks are asked about."""

SHOCKED, STRIDES = 0.3, (3.0, 1.4)
"""Least noise of the process that is tried first, of what was thought to be all noise of a step; and factors by which variances are tried
larger and smaller.
"""

OUTLIER = 4.5
"""|z| above which a step is given a variance of its own when Q and R are estimated; white noise has one such in 150 000."""

ORDERS = 4
"""Highest order of the autoregression."""

MEMORIES = (8.0, 32.0, 128.0, 512.0)
SPARE = 4
"""Steps that the running means remember by which noise is foretold that wanders more slowly than an autoregression of a few steps can say:
the wind, a load that shifts, a slope. A process that forgets within T steps, under white noise, is foretold by such a mean. They are
asked for where there are SPARE times as many steps.
"""

LOUDEST = 30.0
"""Times the white noise that drives it: noise that is louder has no law that holds for long."""

WANDERS = 1.5
"""Times the Bayes criterion's price for a number, from which on noise is taken to wander."""

NARROWEST = 0.7
"""Least standard deviation of z that is believed: below it the noise stands at its floor, which is meant to stay (and far below it
there is no noise whose colour could be told)."""

HIDDEN = 1.0
"""Times its own noise that of others in a state's residual, from which on that residual alone says too little of it: an encoder beside a
speed that is as loud as a filter leaves it.
"""

DRAWN = 16
"""Columns of what S^-1 makes of signs by chance: the slope along a variance is then known to a quarter of its own scatter, or better."""

ROUNDS, HALVINGS, FARTHEST_MOVE, NEAR_ENOUGH, AT_BOUND = 40, 6, 2.0, 0.02, 1e-6
"""Steps of scoring; halvings of one; its length at most, in logarithms; nats that the next one must promise and the last one have brought;
how near a bound is there.
"""

ENOUGH = 6000
"""Steps from which Q and R are estimated at most; their relative error is then about 2 %."""


ROUNDED, DIGITS = 10, 1e-3
"""Changes of a state that must be whole multiples of the smallest one before it counts as rounded; and how far from one another those of
one step of rounding are, of themselves, by the digits that are written: what a robot does lies farther apart.
"""

WIDENED = (0.0, 1e-12, 1e-8, 1e-4, 1.0)
"""Shares by which variances are made larger until rounding leaves their matrix positive definite: a candidate of somebody's own model may
magnify what is measured by so much that the rest is lost beside it. It explains nothing, and shall say so, not end the search.
"""

FARTHEST = 1e200
"""Of a variance, for the same reason."""


@dataclass(frozen=True)
class Noise:
    """Variances by state, (nx,): q of the process a step, r of the measurement. axes: (position, speed) columns of which the speed was not
    measured (`speed_noise`): their r stands for `not at all`.
    """

    q: Array
    r: Array
    axes: tuple[tuple[int, int], ...] = ()

    def one_step(self, f: Array) -> Array:
        """(nx,) standard deviation of a one-step residual, over the F (n, nx, nx) given."""
        return np.asarray(np.sqrt(self.q + self.r + np.mean(f**2, axis=0) @ self.r))


class Whitener:
    """z = L^-1 r for r (n, nx) or (n, nx, m). `logdet`: of L. extra: (n, nx) variance added to the diagonal; push: (n, nx), what noise of
    its own pushes along in each step, by how much.
    """

    def __init__(self, noise: Noise, f: Array, joined: Mask, extra: Array | None = None, push: Array | None = None) -> None:
        from scipy.linalg import lapack

        n, nx = f.shape[:2]
        ft = np.ascontiguousarray(f.transpose(1, 2, 0))
        rf = ft * noise.r[:, None]  # F R, (nx, nx, n)
        linked = np.where(joined[1:], -rf[:, :, 1:], 0.0)
        band = np.zeros((2 * nx, n, nx))
        for a in range(nx):
            band[0, :, a] = noise.q[a] + noise.r[a] + (0.0 if extra is None else extra[:, a])
            for b in range(nx):
                if a >= b:
                    band[a - b, :, b] += np.sum(rf[a] * ft[b], axis=0)
                    if push is not None:
                        band[a - b, :, b] += push[:, a] * push[:, b]
                band[nx + a - b, :-1, b] = linked[a, b]
        for p, v in noise.axes:  # what pushes an axis all through a step moves it, too
            h = ft[p, v]
            band[0, :, p] += noise.q[v] * h * h / 3.0
            band[abs(v - p), :, min(p, v)] += noise.q[v] * h / 2.0
        band[0] = np.minimum(band[0], FARTHEST)
        for more in WIDENED:
            band[0] *= 1.0 + more
            self._lower, info = lapack.dpbtrf(band.reshape(2 * nx, n * nx), lower=1)
            if info == 0:
                break
        else:
            raise ValueError("the noise has no positive definite covariance")
        self._size = self._lower[0].copy()
        self._lower /= self._size  # L = U D, ones on U's diagonal: rows wait for one another, and most of all for divisions
        self.logdet = float(np.sum(np.log(self._size)))

    def __call__(self, r: Array) -> Array:
        """Same shape as r."""
        return self.columns(r.reshape(r.shape[0] * r.shape[1], -1)).reshape(r.shape)

    def columns(self, r: Array) -> Array:
        """The same of r (n nx, m)."""
        from scipy.linalg import lapack

        z, _ = lapack.dtbtrs(self._lower, r, uplo="L", diag="U")
        z /= self._size[:, None]
        return np.asarray(z)

    def back(self, z: Array) -> Array:
        """L^-T z for z (n, nx) or (n, nx, m), same shape: S^-1 r of z = L^-1 r."""
        from scipy.linalg import lapack

        scaled = z.reshape(z.shape[0] * z.shape[1], -1) / self._size[:, None]
        r, _ = lapack.dtbtrs(self._lower, scaled, uplo="L", trans="T", diag="U")
        return np.asarray(r).reshape(z.shape)


def log_density(z: Array) -> Array:
    """log of the density of z, elementwise, without the normal's constant."""
    half = 0.5 * z * z
    return np.asarray(math.log(TAIL / WIDE) - half / WIDE**2 + np.log(1.0 + (1.0 - TAIL) * WIDE / TAIL * np.exp((WIDE**-2 - 1.0) * half)))


def weight(z: Array) -> Array:
    """How much a value counts in least squares, in (WIDE^-2, 1): -(log density)'/z."""
    wild = 1.0 / (1.0 + np.exp(np.clip(math.log((1.0 - TAIL) * WIDE / TAIL) - 0.5 * z * z * (1.0 - WIDE**-2), -700.0, 700.0)))
    return np.asarray(1.0 - wild * (1.0 - WIDE**-2))


def estimate(r: Array, f: Array, joined: Mask, floor: Noise, near: Noise | None = None) -> Noise:
    """Q and R of the residual r (n, nx). floor: least variances. near: where to look first.

    Outlying steps, if they are few, are given a variance of their own, so that they do not count for the others.
    """
    rows = _middle(joined, ENOUGH)
    r, f, joined = r[rows], f[rows], joined[rows].copy()
    joined[0] = False
    robust = np.maximum((np.median(np.abs(r), axis=0) / 0.6745) ** 2, floor.q + 2.0 * floor.r)
    rough = np.maximum(np.abs(r) / np.sqrt(robust) / OUTLIER, 1.0) ** 2 - 1.0
    few = np.mean(rough > 0.0, axis=0) < 0.1  # more than that is no tail but the bulk of what is missing
    extra = np.where(few, rough * robust, 0.0)
    extra[:, [v for _, v in floor.axes]] = 0.0
    noise = _by_state(r, f, joined, extra, near, floor)
    hidden = hidden_by_others(f, noise)
    if hidden:
        noise = together(r, f, joined, extra, (noise,) if near is None else (noise, near), floor)
    for _ in range(2):
        z = Whitener(noise, f, joined, extra)(r)
        wild = np.abs(z) > OUTLIER
        if not wild.any():
            break
        seen = np.where(np.isin(range(r.shape[1]), [v for _, v in floor.axes]), 0.0, noise.r)
        own = noise.q + seen + f**2 @ seen
        extra += np.where(wild, (z**2 / 4.0) * (own + extra), 0.0)
        noise = together(r, f, joined, extra, (noise,), floor) if hidden else _by_state(r, f, joined, extra, noise, floor)
    if not noise.axes and are_shocks(r, f, joined, OUTLIER * np.sqrt(robust)):
        return _after_shocks(r, f, joined, noise, floor)
    return noise


def _after_shocks(r: Array, f: Array, joined: Mask, noise: Noise, floor: Noise) -> Noise:
    """With as much noise of the process as is likeliest where outlying steps are given no variance of their own, if many steps after them
    are wild then: what a shock has moved stays there, and a filter that knows of no noise of the process does not believe it.
    """

    def told(level: Noise) -> tuple[float, Array]:
        whiten = Whitener(level, f, joined)
        z = whiten(r)
        return float(np.sum(log_density(z))) - whiten.logdet, np.mean(np.abs(z) > OUTLIER, axis=0)

    best, wild = told(noise)
    asked = np.zeros(len(wild), dtype=bool)
    while np.any(wild[~asked] > OFTEN):  # states that follow from the one that is hit are wild, too, and no more once it is known
        firsts = [(told(shocked), shocked, i) for i, shocked in _shocked(noise) if wild[i] > OFTEN and not asked[i]]
        (reached, then), there, i = max(firsts, key=lambda one: one[0][0])
        if reached <= best:
            break
        asked[i], best, noise, wild = True, reached, there, then
        for factor in STRIDES:
            moved = True
            while moved:
                moved = False
                for more_q, more_r in ((factor, 1.0), (1.0 / factor, 1.0), (1.0, factor), (1.0, 1.0 / factor)):
                    q, seen = max(more_q * noise.q[i], floor.q[i]), max(more_r * noise.r[i], floor.r[i])
                    reached, then = told(there := _with(noise, i, q, seen))
                    if reached > best + NEAR_ENOUGH:
                        best, noise, wild, moved = reached, there, then, True
    return noise


def _shocked(noise: Noise) -> list[tuple[int, Noise]]:
    """With each state's process as noisy as is tried first."""
    return [(i, _with(noise, i, max(q, SHOCKED * (q + r)), r)) for i, (q, r) in enumerate(zip(noise.q, noise.r, strict=True))]


def _with(noise: Noise, i: int, q: float, r: float) -> Noise:
    """With other variances of one state."""
    variances = noise.q.copy(), noise.r.copy()
    variances[0][i], variances[1][i] = q, r
    return Noise(*variances, noise.axes)


def hidden_by_others(f: Array, noise: Noise) -> bool:
    """Whether others' measurement noise hides some state's own in its residual."""
    if noise.axes:
        return False
    share = np.mean(f**2, axis=0)  # (nx, nx) of state j's variance in the residual of state i
    own = noise.q + noise.r * (1.0 + np.diag(share))
    return bool(np.any(share @ noise.r - np.diag(share) * noise.r > HIDDEN * own))


def together(r: Array, f: Array, joined: Mask, extra: Array, near: Sequence[Noise], floor: Noise) -> Noise:
    """Q and R of all states by maximum likelihood of the whole residual, over their logarithms, from the likeliest of `near` (what another
    model left may lie where this does not come away from): scoring with the average information, as `state_noise` does for one state.
    With V the covariance that a variance makes, s = S^-1 r and s' drawn with covariance S^-1,

        slope  v/2 (s' V s - E s'' V s''),      bend  v_i v_j / 2 (V_i s)' S^-1 (V_j s)
    """
    nx, least = r.shape[1], np.log(np.concatenate([floor.q, floor.r]))
    drawn = np.random.default_rng(0).choice([-1.0, 1.0], size=(*r.shape, DRAWN))
    goes_on = np.append(joined[1:], False)[:, None, None]

    def at(logs: Array) -> tuple[Whitener, float]:
        v = np.exp(logs)
        whiten = Whitener(Noise(v[:nx], v[nx:]), f, joined, extra)
        return whiten, float(0.5 * np.sum(whiten(r) ** 2)) + whiten.logdet

    starts = [np.maximum(np.log(np.maximum(np.concatenate([one.q, one.r]), 1e-300)), least) for one in near]
    logs, (whiten, cost) = min(((start, at(start)) for start in starts), key=lambda begun: begun[1][1])
    for _ in range(ROUNDS):
        s = whiten.back(np.concatenate([whiten(r)[:, :, None], drawn], axis=2))
        first = -np.einsum("kji,kjc->kic", f, s)  # what the error of a step's first measurement is in both steps that have it
        first[1:] += np.where(goes_on[:-1], s[:-1], 0.0)
        last = np.where(goes_on, 0.0, s)  # and of the end of a run, which is in one
        sizes = np.concatenate([np.sum(s**2, axis=0), np.sum(first**2, axis=0) + np.sum(last**2, axis=0)])
        slope = 0.5 * np.exp(logs) * (sizes[:, 0] - np.mean(sizes[:, 1:], axis=1))
        ends = np.where(goes_on[:, :, 0], np.append(first[1:, :, 0], np.zeros((1, nx)), axis=0), last[:, :, 0])
        each = np.eye(nx)[None]
        of_r = ends[:, None, :] * each - f * first[:, None, :, 0]
        table = whiten(np.concatenate([s[:, :, :1] * each, of_r], axis=2)).reshape(-1, 2 * nx) * np.exp(logs)
        move, brings = _scored(slope, 0.5 * table.T @ table, logs - least)
        if brings < NEAR_ENOUGH:
            break
        for halving in range(HALVINGS):
            there = np.maximum(logs + 0.5**halving * move, least)
            other, reached = at(there)
            if reached < cost:
                break
        if not reached < cost:
            break
        won, logs, whiten, cost = cost - reached, there, other, reached
        if won < NEAR_ENOUGH:
            break
    return Noise(np.exp(logs[:nx]), np.exp(logs[nx:]))


def _scored(slope: Array, bend: Array, room: Array) -> tuple[Array, float]:
    """A step of scoring, (m,), and the nats that it would bring. What is at its least and would fall stays. room: above it. Where the
    slope is steeper than the bend, a variance grows or shrinks by e at most: one that is next to nothing has hardly a bend.
    """
    free, move = np.ones(len(slope), dtype=bool), np.zeros(len(slope))
    while free.any():
        move[:] = 0.0
        part = bend[np.ix_(free, free)]
        steep = np.maximum(np.abs(slope[free]) - np.diag(part), 0.0)
        move[free] = np.linalg.solve(part + np.diag(steep + 1e-9 * (1.0 + np.diag(part))), slope[free])
        stays = free & (room <= AT_BOUND) & (move < 0.0)
        if not stays.any():
            break
        free &= ~stays
        move[:] = 0.0
    move *= min(1.0, FARTHEST_MOVE / max(float(np.max(np.abs(move))), 1e-300))
    return move, float(slope @ move - 0.5 * move @ bend @ move)


def _middle(joined: Mask, most: int) -> slice:
    """At most so many steps, from the middle."""
    n = len(joined)
    begin = max(0, (n - most) // 2)
    return slice(begin, min(n, begin + most))


def _by_state(r: Array, f: Array, joined: Mask, extra: Array, near: Noise | None, floor: Noise) -> Noise:
    """State by state; twice, if one state's measurement noise is a good part of another's residual."""
    nx = r.shape[1]
    q, s = (np.zeros(nx), np.zeros(nx)) if near is None else (near.q.copy(), near.r.copy())
    square = f**2
    for p, v in floor.axes:
        ends = np.ix_(range(len(r)), (p, v), (p, v))
        least = float(floor.q[v]), float(floor.r[p]), float(floor.r[v])
        q[v], s[p] = of_axis(r[:, [p, v]], f[ends], joined, extra[:, p], least, None if near is None else (q[v], s[p]))
        q[p], s[v] = floor.q[p], floor.r[v]
    alone = [i for i in range(nx) if not any(i in pair for pair in floor.axes)]
    for _ in range(2 if alone else 0):
        foreign = np.zeros(nx)
        for i in alone:
            others = square[:, i] @ s - square[:, i, i] * s[i]
            start = None if near is None else (q[i], s[i])
            q[i], s[i] = of_state(r[:, i], f[:, i, i], joined, extra[:, i] + others, (float(floor.q[i]), float(floor.r[i])), start)
        for i in alone:
            foreign[i] = np.mean(square[:, i] @ s - square[:, i, i] * s[i]) / (q[i] + s[i])
        near = Noise(q, s)
        if np.all(foreign < 0.02):
            break
    return Noise(q, s, floor.axes)


@dataclass(frozen=True)
class Colour:
    """Autoregression of z by state: coefficients (nx, ORDERS), scale (nx,); slow: (nx, MEMORIES), on running means, or empty."""

    coefficients: Array
    scale: Array
    slow: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def strength(self) -> Array:
        """(nx,) largest coefficient."""
        return np.asarray(np.max(np.abs(self.coefficients), axis=1))

    def __call__(self, z: Array, joined: Mask) -> Array:
        """What of z (n, nx) or (n, nx, m) the past does not foretell, in standard deviations."""
        if not self.slow.size and not np.any(self.coefficients):
            return z if np.all(self.scale == 1.0) else np.asarray(z / self.scale.reshape((1, -1) + (1,) * (z.ndim - 2)))
        out = z.copy()
        for k, memory in enumerate(MEMORIES if self.slow.size else ()):
            out -= self.slow[:, k].reshape((1, -1) + (1,) * (z.ndim - 2)) * _recently(z, joined, memory)
        there = joined.copy()
        for lag in range(1, self.coefficients.shape[1] + 1):
            if lag > 1:
                there = there & np.append(False, there[:-1])
            for i in np.flatnonzero(self.coefficients[:, lag - 1]).tolist():
                past = np.where(there[lag:].reshape((-1,) + (1,) * (z.ndim - 2)), z[:-lag, i], 0.0)
                out[lag:, i] -= self.coefficients[i, lag - 1] * past
        return np.asarray(out / self.scale.reshape((1, -1) + (1,) * (z.ndim - 2)))


def log_likelihood(z: Array, whiten: Whitener, colour: Colour, joined: Mask) -> float:
    """Of a residual that is whitened to z (n, nx), under a colour of that."""
    left = float(np.sum(log_density(colour(z, joined))))
    return left - whiten.logdet - len(z) * float(np.sum(np.log(colour.scale)))


def no_colour(nx: int) -> Colour:
    """For white noise."""
    return Colour(np.zeros((nx, ORDERS)), np.ones(nx))


def colour(z: Array, joined: Mask) -> Colour:
    """The autoregression that the Bayes criterion chooses for each state, fitted on z cut at 4 standard deviations."""
    n, nx = z.shape
    coefficients, scale = np.zeros((nx, ORDERS)), np.ones(nx)
    clipped = np.clip(z, -4.0, 4.0)
    lagged = _lagged(clipped, joined)
    for i in range(nx):
        spread = max(float(np.mean(clipped[:, i] ** 2)), 1e-12)
        best, own = n * math.log(spread), max(math.sqrt(spread), NARROWEST)
        scale[i] = own
        product, slope = lagged[i] @ lagged[i].T, lagged[i] @ clipped[:, i]
        if not spread > 0.25 * NARROWEST**2:  # nor where it is no number
            continue
        # Its first rows and columns are the factor of each lower order.
        factor = np.linalg.cholesky(product + 1e-9 * n * spread * np.eye(ORDERS))
        brought = np.cumsum(np.linalg.solve(factor, slope) ** 2) / n
        chosen = 0
        for order, less in enumerate(brought.tolist(), 1):
            left = max(spread - less, 1e-12)
            score = n * math.log(left) + (order + 1.0) * math.log(n)
            if score < best - 1e-9:
                best, scale[i], chosen = score, own * math.sqrt(left / spread), order
        part = factor[:chosen, :chosen]
        coefficients[i, :chosen] = np.linalg.solve(part @ part.T, slope[:chosen])
    return Colour(coefficients, scale)


class Past:
    """Draws noise of a colour, a step at a time, in many rows at once: (m, nx)."""

    def __init__(self, colour: Colour, shape: tuple[int, ...]) -> None:
        self._colour = colour
        self._last = [np.zeros(shape) for _ in range(ORDERS)]
        self._means = [np.zeros(shape) for _ in (MEMORIES if colour.slow.size else ())]
        self._size = np.full(shape[1], 0.0)
        self._white = np.full(shape[1], 0.0)

    def follow(self, white: Array) -> Array:
        """The next values, from white noise (or such as whitening makes white) of this step."""
        c = self._colour
        now = c.scale * white + sum(c.coefficients[:, k] * past for k, past in enumerate(self._last))
        now = now + sum(c.slow[:, k] * mean for k, mean in enumerate(self._means))
        keeps = [math.exp(-1.0 / memory) for memory in MEMORIES]
        self._means = [keep * mean + (1.0 - keep) * now for keep, mean in zip(keeps, self._means, strict=False)]
        self._last = [now, *self._last[:-1]]
        self._size, self._white = (np.sqrt(np.mean(e**2, axis=0)) for e in (now, white))
        return np.asarray(now)

    @property
    def settled(self) -> bool:
        """Whether the last values are of a size that such noise can have."""
        return bool(np.all(self._size < LOUDEST * self._white + 1e-300))


def wandering(z: Array, joined: Mask, given: Colour) -> Colour | None:
    """The colour with running means besides, where these foretell z beyond doubt in some state; else None. given: the colour without."""
    n, nx = z.shape
    clipped = np.clip(z, -4.0, 4.0)
    means = np.stack([_recently(clipped, joined, memory) for memory in MEMORIES], axis=2)
    few = [k for k, memory in enumerate(MEMORIES) if SPARE * memory <= n]
    sets = [[k] for k in few] + ([few] if len(few) > 1 else [])
    known = np.flatnonzero(np.mean(clipped**2, axis=0) > 0.25 * NARROWEST**2)
    coefficients, scale, slow = given.coefficients.copy(), given.scale.copy(), np.zeros((nx, len(MEMORIES)))
    lagged = _lagged(clipped, joined)
    for i in known.tolist():
        order = int(np.max(np.flatnonzero(given.coefficients[i]) + 1, initial=0))
        now = clipped[:, i]
        usual = float(np.mean((now - given.coefficients[i] @ lagged[i]) ** 2))
        best = 0.0
        for those in sets:
            x = np.concatenate([lagged[i, :order].T, means[:, i, those]], axis=1)
            c = np.linalg.lstsq(x, now, rcond=1e-4)[0]
            left = max(float(np.mean((now - x @ c) ** 2)), 1e-12)
            score = n * math.log(usual / left) - WANDERS * len(those) * math.log(n)
            if score > best:
                best, scale[i] = score, given.scale[i] * math.sqrt(left / usual)
                coefficients[i, :order], slow[i] = c[:order], 0.0
                slow[i, those] = c[order:]
    return Colour(coefficients, scale, slow) if np.any(slow) else None


def no_steadier(law: Colour, given: Colour, floored: Mask) -> Colour:
    """The law less that of states (nx,) whose process noise stands at its floor and which wander less than white noise does: that says no
    more than that the floor is higher than what is there. It is meant to be: no model is believed to be more exact.
    """
    drop = floored & (law.slow.sum(axis=1) < 0.0)
    one = drop[:, None]
    return Colour(np.where(one, given.coefficients, law.coefficients), np.where(drop, given.scale, law.scale), np.where(one, 0.0, law.slow))


def _recently(z: Array, joined: Mask, memory: float) -> Array:
    """Running mean of what was before each step, as z: m_k = a m_{k-1} + (1 - a) z_{k-1}, a = exp(-1/memory), zero where a run begins."""
    from scipy.linalg import lapack

    keep = math.exp(-1.0 / memory)
    flat = z.reshape(len(z), -1)
    band = np.ones((2, len(z)))
    band[1, :-1] = np.where(joined[1:], -keep, 0.0)
    before = np.concatenate([np.zeros((1, flat.shape[1])), np.where(joined[1:, None], flat[:-1], 0.0)])
    means, _ = lapack.dtbtrs(band, (1.0 - keep) * before, uplo="L", diag="U")
    return np.asarray(means).reshape(z.shape)


def _lagged(z: Array, joined: Mask) -> Array:
    """(nx, ORDERS, n): z one step before and more, zero where that is not known."""
    n, nx = z.shape
    lagged = np.zeros((nx, ORDERS, n))
    there = joined.copy()
    for lag in range(ORDERS):
        if lag:
            there = there & np.append(False, there[:-1])
        lagged[:, lag, lag + 1 :] = z[: n - lag - 1].T
        lagged[:, lag, ~there] = 0.0
    return lagged


def quantum(before: Array, after: Array) -> float:
    """The step in which a measured state is rounded; 0 if it is not. (n,) at the start and at the end of steps, angles unwrapped.

    An angle that was rounded within a turn is rounded afresh where it passes the turn's end, at pi or at zero: that change is no multiple.
    Changes that are nearly all about as large, but not as digits are, are no steps of rounding: a robot turns as fast as it can.
    """
    change = after - before
    afresh = (np.floor(before / math.pi) != np.floor(after / math.pi)) & (np.abs(change) < math.pi)
    sizes = np.abs(change[(change != 0.0) & ~afresh])
    if len(sizes) < ROUNDED:
        return 0.0
    least = float(np.min(sizes))
    sizes = sizes[sizes < 1000.0 * least] / least
    whole = np.abs(sizes - np.rint(sizes)) < 0.02
    alike = np.mean(np.rint(np.abs(change) / least) == 1.0) >= 0.95 and float(np.quantile(sizes, 0.9)) > 1.0 + DIGITS
    return least if len(sizes) >= ROUNDED and np.mean(whole) > 0.95 and not alike else 0.0
