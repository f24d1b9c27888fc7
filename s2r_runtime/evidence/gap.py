"""Gap of a model on independent transitions (guarantee G1, G4, G6; paper, theorem 2).

    e_i = x1_i (-) f(x0_i, u_i)          residual, (n, nx), angles wrapped
    d_i = sqrt(sum_j (w_j e_ij)^2)       ball;   max_j w_j |e_ij|   box;   W fixed beforehand
    r   = the (k+1)-th largest d_i       P[V(r) > eps] <= P(Bin(n, eps) <= k) <= beta

With the state after h held periods (one value a hold, so independent too), r_h is the same of the h-step discrepancy; then r
and r_h take beta/2 each. Transitions without it, or too few to pay for both, give h = 1 and r_h = r, which is the same
statement once more and costs nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import check_probability, sample_size, scenario_confidence, split
from s2r_runtime.evidence.prediction import acting_over, hold_residuals, residuals
from s2r_runtime.evidence.repeats import Repeats, repeats
from s2r_runtime.evidence.seen_rows import seen
from s2r_runtime.evidence.whiteness import DEPENDENT, SERIAL_ALPHA, Whiteness, body_axes, serial_p, whiteness
from s2r_runtime.messages import NOT_INDEPENDENT, SERIAL, Gap
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import is_sketch
from s2r_runtime.profile.checks import HEAVIEST, LIGHTEST
from s2r_runtime.recordings.transitions import Transitions

Array = NDArray[np.float64]
Kind = Literal["ball", "box"]

__all__ = [
    "Kind", "blocked", "discrepancy", "doubted", "estimate_gap", "gap_json", "hold_residuals", "noise_share",
    "radius_of_noise", "refuse_fitted", "residuals", "statement",
]  # fmt: skip

COPIES = "copies"
"""The reason in `Gap.rejected` for rows that are copies of others, and so do not count."""
NOISE_DRAWS = 200_000
"""Simulated transitions behind `radius_noise`: its own error is then a few per cent of it."""


def discrepancy(e: Array, weights: Array, kind: Kind) -> Array:
    """(n,) weighted norms of e (n, nx); weights (nx,)."""
    weighted = np.abs(e * weights)
    return np.sqrt(np.sum(weighted**2, axis=1)) if kind == "ball" else np.asarray(np.max(weighted, axis=1))


def estimate_gap(
    model: ComposedModel,
    tr: Transitions,
    *,
    epsilon: float,
    beta: float,
    discard: int = 0,
    kind: Kind = "ball",
    weights: tuple[float, ...] | Array,
    epoch: int = 1,
) -> Gap:
    """The gap at `beta` (the epoch's share). All samples count, copies of one once; N and k were fixed before they were drawn.

    `radius` is the (k+1)-th largest of all rows, with their copies, and n the number of different ones: sound whether copies are of one
    draw or equal draws of a law of few values. Rows that repeat each other more than by chance give their numbers and no statement.

    Raises UsageError (range of a number), NotEnoughEvidence (fitted on this recording: G6; too few samples, saying how many more).
    Transitions that are not independent give their numbers and no statement; how many there are does not matter then.
    """
    w = _checked_weights(model, weights, kind)
    check_probability("epsilon", epsilon)
    check_probability("beta", beta)
    if discard < 0:
        raise UsageError(f"discard is {discard}, must be >= 0")
    refuse_fitted(model, tr)
    alike = different(model, tr)
    if alike.doubt:
        tr = replace(tr, independent=False)
    if alike.distinct < len(tr.x0):
        tr = replace(tr, rejected={**tr.rejected, COPIES: len(tr.x0) - alike.distinct})
    n = alike.distinct
    needed = sample_size(epsilon, beta, discard)
    if n < (needed if tr.independent else discard + 1):
        raise NotEnoughEvidence(_too_few(tr, n, needed, epsilon, beta, discard), needed - n)
    e = residuals(model, tr)
    radius = _largest(discrepancy(e, w, kind), discard)
    e_hold = hold_residuals(model, tr)
    paid = e_hold is not None and (not tr.independent or scenario_confidence(n, discard, epsilon) <= split(beta, (1, 1))[0])
    white = Whiteness(False, alike.doubt) if alike.doubt else _structure(model, tr, e, e_hold, w, kind)
    return Gap(
        radius=radius,
        radius_literal=_largest(discrepancy(e, np.ones_like(w), kind), discard),
        hold_radius=_largest(discrepancy(e_hold, w, kind), discard) if e_hold is not None and paid else radius,
        hold_periods=tr.hold_periods if paid else 1,
        set=kind,
        weights=tuple(w.tolist()),
        n=n,
        discarded=discard,
        epsilon=epsilon,
        beta=beta,
        epoch=epoch,
        model_digest=model.spec.digest(),
        transitions_digest=tr.digest,
        rejected=tr.rejected,
        radius_noise=radius_of_noise(model, tr, w, kind, discard),
        white=white.white,
        white_reason=white.reason,
    )


def _structure(model: ComposedModel, tr: Transitions, e: Array, e_hold: Array | None, w: Array, kind: Kind) -> Whiteness:
    """What the residual e (n, nx) has besides noise; of samples, their order before all else. e_hold: after the whole hold, (n, nx)."""
    if tr.independent:
        both = [one for one in (e, e_hold) if one is not None]
        series = [*(discrepancy(one, w, kind) for one in both), *(c for one in both for c in body_axes(model, tr.x0, one).T)]
        if (found := _in_order(series, 1e-12 * max(1.0, float(np.max(np.abs(tr.x0)))))) is not None:
            return found
    return whiteness(model, tr.x0, tr.u, e, first_lag=1 if tr.independent else 2)


def _in_order(series: list[Array], rounding: float) -> Whiteness | None:
    """What speaks clearly against the independence of the samples: the order of their discrepancies and residuals, each (n,).

    rounding: of a state, which follows the state; so does a part in 1e9 of a value.
    """
    steps = [max(rounding, 1e-9 * float(np.max(np.abs(one)))) for one in series]
    p = min(serial_p(np.round(one / step), clear=SERIAL_ALPHA / len(series)) for one, step in zip(series, steps, strict=True)) * len(series)
    return Whiteness(False, f"{SERIAL} (p = {p:.1g})") if p < SERIAL_ALPHA else None


def different(model: ComposedModel, tr: Transitions) -> Repeats:
    """How many of the transitions count, and why chance does not make them, where it does not. Those of a drive are no draws: all count.

    Where a person vouches for blocks of a drive, copies count once; a robot that stands still repeats itself, which is no doubt of them.
    """
    if not tr.independent:
        return Repeats(len(tr.x0), "")
    found = repeats(tr.x0, tr.u, tr.x1, model.angle_columns)
    return found._replace(doubt="") if tr.assumption else found


def refuse_fitted(model: ComposedModel, tr: Transitions) -> None:
    """Raises NotEnoughEvidence if the model was fitted on this recording, these samples, or some of their rows (G6)."""
    if {tr.digest, tr.samples_digest, tr.content_digest, *tr.parts} & set(model.spec.fitted_on) - {""}:
        raise NotEnoughEvidence(
            f"{tr.source}: the model was fitted on this recording, which therefore can't bound its gap; take one that the fit never saw"
        )
    for text in model.spec.fitted_on:
        if is_sketch(text) and (found := seen(text, tr.measured or (tr.x0, tr.x1))).refused:
            raise NotEnoughEvidence(
                f"{tr.source}: the model was fitted on {found.rows / found.of:.3g} of its rows ({found.rows} of {found.of}), so it can't "
                "bound its gap; take a recording that the fit never saw"
            )


def radius_of_noise(model: ComposedModel, tr: Transitions, weights: Array, kind: Kind, discard: int) -> float | None:
    """What r would be if the model were exact and only the measurements noisy; None where `noise` isn't known.

    The median over simulated campaigns of the same n with Gaussian noise of that size on both x0 and x1. Not an upper bound, and no part
    of the statement: outliers, quantisation and drift of a sensor aren't in it.
    """
    if tr.noise is None:
        return None
    rng = np.random.default_rng(0)
    n = len(tr.x0)
    largest = []
    mean, end, lasts = acting_over(model, replace(tr, drive=None))  # in a drive, what a moment of noise does does not hang on its past
    exact = model.advance(tr.x0, mean, end, lasts)
    for _ in range(min(101, max(9, NOISE_DRAWS // n))):
        d = np.empty(n)
        for a in range(0, n, NOISE_DRAWS):
            rows = slice(a, a + NOISE_DRAWS)
            before, after = rng.normal(size=(2, *tr.x0[rows].shape)) * tr.noise
            moved = model.advance(tr.x0[rows] + before, mean[rows], end[rows], None if lasts is None else lasts[rows])
            d[rows] = discrepancy(model.difference(exact[rows] + after, moved), weights, kind)
        largest.append(_largest(d, discard))
    return float(np.median(largest))


def blocked(tr: Transitions, seconds: float, dt: float) -> Transitions:
    """The first transition of every block of that length, no two nearer than that; independent under the assumption that blocks are, which
    is then stated.

    dt: the model's step, s; neighbours share a measurement, so a block takes two steps at least. The digests stay those of the
    recording. Raises UsageError if the block is shorter, or these are no drive: segments and samples of a campaign are independent
    already, or for a reason that no assumption about time mends.
    """
    if not 0.0 < seconds < float("inf"):
        raise UsageError(f"blocking is {seconds} s, must be > 0")
    if seconds < 2.0 * dt * (1.0 - 1e-9):
        raise UsageError(
            f"blocking is {seconds:g} s, must be at least two steps of the model, {2.0 * dt:g} s: neighbours share a measurement"
        )
    if tr.independent:
        raise UsageError(f"{tr.source}: blocking is for ordinary driving and has no use here: its transitions count as independent already")
    if len(tr.t0_s) == 0:
        return tr
    if tr.drive is None:
        raise UsageError(f"{tr.source}: blocking is for ordinary driving, here {tr.doubt}")
    block = np.floor((tr.t0_s - tr.t0_s[0]) / seconds)
    _, first = np.unique(block, return_index=True)
    apart = np.diff(tr.t0_s[first], prepend=-np.inf)
    first = first[apart >= seconds - 1.5 * dt]  # where a hole delayed the one of a block, the next block's may be too near
    return replace(
        tr.chosen(first),
        independent=True,
        doubt="",
        assumption=f"transitions from different blocks of {seconds:g} s of this drive, one from each, are independent and of one law",
        rejected={**tr.rejected, "blocking": len(tr.x0) - len(first)},
    )


def doubted(gap: Gap, tr: Transitions, reasons: tuple[str, ...] = NOT_INDEPENDENT) -> Transitions:
    """The transitions, with a doubt where they repeat each other or their order matters: then their gap has no statement (guarantee G1).

    reasons: which of NOT_INDEPENDENT count.
    """
    if not tr.independent or not gap.white_reason.startswith(reasons):
        return tr
    return replace(tr, independent=False, doubt=f"the samples were not drawn independently: {gap.white_reason}")


def statement(gap: Gap, independent: bool, *, assumption: str = "", doubt: str = "", states: tuple[str, ...] = (), law: str = "") -> str:
    """What G1 says of this gap, and no more. law: which period of a hold gave each sample, if that is known."""
    rank = "largest" if gap.discarded == 0 else f"largest but {gap.discarded}"
    if not independent:
        why = doubt or "the transitions were not drawn independently"
        return f"No statement: {why}. r = {gap.radius:.6g} is the {rank} of these {gap.n} discrepancies and bounds no other."
    norm = ", ".join(f"{name} {w:g}" for name, w in zip(states or range(len(gap.weights)), gap.weights, strict=True))
    told = (
        f"With confidence {_percent(1.0 - gap.beta)}, a new one-step discrepancy drawn from the same law exceeds r = {gap.radius:.6g} "
        f"({gap.set}, weights {norm}) with probability at most {_percent(gap.epsilon)}"
    )
    if gap.hold_periods > 1:
        told += (
            f", and one after {gap.hold_periods} held periods exceeds r_h = {gap.hold_radius:.6g} with probability at most "
            f"{_percent(gap.epsilon)} (either takes half of the {_percent(gap.beta)})"
        )
    lines = [told + "."]
    lines.append(
        f"{gap.n} independent transitions, {gap.discarded} discarded, both fixed beforehand; for r alone the confidence is "
        f"{_percent(1.0 - scenario_confidence(gap.n, gap.discarded, gap.epsilon))}."
    )
    if law:
        lines.append(f"Each is {'one period drawn uniformly from' if law == 'random' else 'the first period of'} a held input.")
    if assumption:
        lines.append(f"This rests on an assumption that the user made: {assumption}.")
    if DEPENDENT in gap.white_reason:
        lines.append(f"Against the independence speaks that {gap.white_reason}.")
    noise = f"; noise alone would make about {noise_share(gap.radius_noise, gap.radius)} of it" if gap.radius_noise is not None else ""
    lines.append(f"r bounds measured discrepancies, with the measurement noise in them{noise}.")
    return " ".join(lines)


def noise_share(noise: float, radius: float) -> str:
    """How much of r measurement noise explains, for a sentence: no more than all of it."""
    return "all" if noise >= 0.95 * radius else f"{noise:.3g}"


def gap_json(gap: Gap, tr: Transitions, states: tuple[str, ...]) -> dict[str, Any]:
    """What `s2r gap --json` prints (docs/json.md)."""
    law = tr.holds.law if tr.holds is not None else ""
    return {
        "radius": gap.radius,
        "radius_literal": gap.radius_literal,
        "radius_noise": gap.radius_noise,
        "hold_radius": gap.hold_radius,
        "hold_periods": gap.hold_periods,
        "n": gap.n,
        "discarded": gap.discarded,
        "epsilon": gap.epsilon,
        "beta": gap.beta,
        "confidence": 1.0 - scenario_confidence(gap.n, gap.discarded, gap.epsilon) if tr.independent else None,
        "set": gap.set,
        "weights": dict(zip(states, gap.weights, strict=True)),
        "independent": tr.independent,
        "assumption": tr.assumption,
        "doubt": tr.doubt,
        "white": gap.white,
        "white_reason": gap.white_reason,
        "rejected": gap.rejected,
        "epoch": gap.epoch,
        "recording": tr.source,
        "subset": tr.subset.to_json() if tr.subset else None,
        "notes": list(tr.notes),
        "model_digest": gap.model_digest,
        "transitions_digest": gap.transitions_digest,
        "period": law,
        "statement": statement(gap, tr.independent, assumption=tr.assumption, doubt=tr.doubt, states=states, law=law),
    }


def _largest(d: Array, k: int) -> float:
    """The (k+1)-th largest of d (n,)."""
    return float(np.partition(d, len(d) - 1 - k)[len(d) - 1 - k])


def _checked_weights(model: ComposedModel, weights: tuple[float, ...] | Array, kind: str) -> Array:
    w = np.asarray(weights, dtype=np.float64)
    if w.shape != (len(model.states),) or not np.all((w >= LIGHTEST) & (w <= HEAVIEST)):
        asked = f"one number > 0 for each of {', '.join(model.states)}, from {LIGHTEST:g} to {HEAVIEST:g}"
        raise UsageError(f"weights are {w.tolist()}, must be {asked}")
    if kind not in {"ball", "box"}:
        raise UsageError(f"set is {kind!r}, must be ball or box")
    return w


def _too_few(tr: Transitions, n: int, needed: int, epsilon: float, beta: float, discard: int) -> str:
    out = f"; left out: {', '.join(f'{count} {reason}' for reason, count in sorted(tr.rejected.items()))}" if tr.rejected else ""
    if not tr.independent and n == 0:
        return f"{tr.source}: holds no transition: no two rows with all states are a step of the model apart{out}"
    if not tr.independent:
        return f"{tr.source}: {n} transitions are there, {discard} of them to be discarded: nothing is left"
    return (
        f"{tr.source}: {n} independent transitions, {needed} are needed for epsilon {epsilon:g}, beta {beta:g} "
        f"and {discard} discarded: {needed - n} more{out}"
    )


def _percent(p: float) -> str:
    return f"{100.0 * p:.4g} %"
