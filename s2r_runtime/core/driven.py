"""What driving showed of the discrepancy, kept over epochs: a gap from samples that saw less carries no deployment (guarantee G5).

When an epoch ends, the counts of its watch give two limits of the discrepancy's (1-epsilon)-quantile while driving (`core.stream`). The
watch of a later epoch tests P(d > r) <= epsilon for its own r. Where the lower limit reaches r, that is known to be false of earlier
driving: the controller would drive until the watch sees it again. So it does not begin to.

Only a person knows that the robot was mended since: `s2r clear driving_exceeds_sampling`.
"""

from __future__ import annotations

import msgspec

from s2r_runtime.core import stream
from s2r_runtime.messages import Driven, Gap, Memory, Settings

REASON = "driving_exceeds_sampling"
KINDS = 8
"""Models, norms and quantiles of which driving is remembered: to adopt another model and this one again forgets nothing."""


def of_watch(memory: Memory, gap: Gap, alpha: float) -> Driven | None:
    """What the watch of the gap in force shows so far; None where it has seen nothing. alpha: of each limit."""
    n = sum(memory.watch_counts)
    if n == 0:
        return None
    lower, upper = (find(memory.watch_counts, gap.radius, gap.epsilon, alpha) for find in (stream.quantile_lower, stream.quantile))
    return Driven(gap.model_digest, gap.set, gap.weights, gap.epsilon, gap.epoch, n, lower, upper)


def kept(memory: Memory, alpha: float) -> tuple[Driven, ...]:
    """What is remembered when the watch in force ends: of each model, norm and quantile the epoch that drove worst, the newest `KINDS`."""
    gap = memory.gap
    now = None if gap is None else of_watch(memory, gap, alpha)
    if gap is None or now is None:
        return memory.driven
    before = _comparable(memory.driven, gap)
    worst = before if before is not None and _level(before) >= _level(now) else now
    return (*(one for one in memory.driven if one is not before), worst)[-KINDS:]


def refusal(memory: Memory, settings: Settings) -> str:
    """Why the gap in force carries no deployment, or empty: earlier driving exceeded it, by the lower limit."""
    gap = memory.gap
    driven = None if gap is None else _comparable(memory.driven, gap)
    if gap is None or driven is None or driven.lower is None or driven.lower < gap.radius:
        return ""
    times = f"{driven.lower / gap.radius:.3g} times" if gap.radius > 0.0 else "beyond"
    return (
        f"{REASON}: in epoch {driven.epoch} the discrepancy's {1.0 - gap.epsilon:g}-quantile while driving was above {driven.lower:.6g} "
        f"(confidence {1.0 - settings.alpha:g}, {driven.n} steps), {times} the gap {gap.radius:.6g} of epoch {gap.epoch}. Sampling misses "
        f"what driving meets; look: s2r trace --live drive. If the robot was mended since: s2r clear {REASON}"
    )


def status(memory: Memory, settings: Settings | None) -> dict[str, object] | None:
    """Of this epoch's driving and that of earlier ones, the worst, with the interval of its quantile over the gap in force.

    None where nothing was driven that compares with that gap. A ratio is None where its limit is not established, or the gap is 0.
    """
    gap = memory.gap
    driven = None if gap is None or settings is None else _comparable(kept(memory, settings.alpha), gap)
    if gap is None or driven is None:
        return None

    def ratio(limit: float | None) -> float | None:
        return None if limit is None or gap.radius <= 0.0 else limit / gap.radius

    return {**msgspec.structs.asdict(driven), "ratio_lower": ratio(driven.lower), "ratio_upper": ratio(driven.upper)}


def _comparable(driven: tuple[Driven, ...], gap: Gap) -> Driven | None:
    """The one of the gap's model, norm and quantile."""
    key = gap.model_digest, gap.set, gap.weights, gap.epsilon
    return next((one for one in driven if (one.model_digest, one.set, one.weights, one.epsilon) == key), None)


def _level(driven: Driven) -> float:
    return -1.0 if driven.lower is None else driven.lower
