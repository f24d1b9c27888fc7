"""What docs/effects.md and docs/trace-recordings.md promise beyond an effect's name: its values, the seconds of a delay, no false fault."""

from __future__ import annotations

import math
from typing import Any

from trace_sets.scoring import own_values

Answer = dict[str, Any]
Truth = dict[str, Any]

TOLERANCE = 0.2
"""Of a parameter's distance from the value at which there is no effect; or the true value lies in the reported interval."""
ANGLE_TOLERANCE = 0.3
"""rad, of phases and directions."""
DELAY_STEPS = 0.5
"""Of the recording: a delay of a sensor is known to half a sample, or to the tolerance."""

NEUTRAL_ONE = {"gain", "gain_positive", "gain_negative", "left", "right"}
RATIOS_OF_ONE = {"steering_ratio", "mass_change"}
DIRECTIONS = {("link_gravity", "angle"), ("torque_ripple", "phase"), ("periodic_disturbance", "phase")}


def close(truth: Truth, answer: Answer) -> bool:
    """Whether each parameter that goes by the truth's own name is near the true value."""
    return all(_near(effect, name, true, value) for effect, name, true, value in own_values(truth, answer))


def _near(effect: str, name: str, true: float, value: dict[str, Any]) -> bool:
    found, low, high = value["value"], value["low"], value["high"]
    if isinstance(low, float | int) and isinstance(high, float | int) and low <= true <= high:
        return True
    if (effect, name) in DIRECTIONS:
        return abs(math.remainder(found - true, math.tau)) <= ANGLE_TOLERANCE
    neutral = 1.0 if name in NEUTRAL_ONE or (name == "ratio" and effect in RATIOS_OF_ONE) else 0.0
    return bool(abs(found - true) <= TOLERANCE * abs(true - neutral))


def false_fault(truth: Truth, answer: Answer) -> bool:
    """Whether a fault is reported of a kind that the recording does not have."""
    return any(f["kind"] in truth.get("no_fault", ()) for f in answer["faults"])


def delay_right(truth: Truth, answer: Answer) -> bool | None:
    """Whether the delay of a sensor is reported with its size; None if nothing is delayed, or nothing promised."""
    true = truth.get("delayed")
    if not true or not true["states"] or truth["expect"] == "unpromised":
        return None
    found = answer.get("states_late") if set(true["states"]) <= {"x", "y", "theta"} else (answer.get("reconstructed") or {}).get("late_s")
    values = found if isinstance(found, dict) else dict.fromkeys(true["states"], found)
    slack = max(TOLERANCE * true["seconds"], DELAY_STEPS / truth["rate"])
    return all(isinstance(v := values.get(s), float | int) and abs(v - true["seconds"]) <= slack for s in true["states"])
