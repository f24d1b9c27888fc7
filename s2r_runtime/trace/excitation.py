"""What to drive so that effects which explain the same data can be told apart.

Each effect is told from the others by what it does to one feature of the input: a bias by zero and both signs, a gain by several
sizes, a limit by sizes up to the largest, memory by steps seen at once after they are made, and one that couples inputs by
values of the one at several values of the other.
"""

from __future__ import annotations

from collections.abc import Iterable

from s2r_runtime.models.composed import ComposedModel

_NEEDS = {
    "input_bias": "zero and both signs",
    "input_gain": "at least three sizes",
    "input_saturation": "sizes from small up to the largest that is allowed",
    "wheel_saturation": "the largest values of each at several values of the other",
    "input_delay": "steps between values far apart, with single periods recorded after each",
    "input_lag": "steps between values far apart, each held until the response has settled",
}
_OTHERWISE = "steps of several sizes and both signs"


def advice(model: ComposedModel, tied: Iterable[tuple[str, str]]) -> str:
    """One sentence. tied: (effect, channel)."""
    wanted: dict[str, list[str]] = {}
    for name, channel in tied:
        for single in model.inputs if channel == "*" else (channel,):
            needs = wanted.setdefault(single, [])
            text = _NEEDS.get(name, _OTHERWISE)
            if text not in needs:
                needs.append(text)
    parts = [f"{channel}: {'; '.join(needs)}" for channel, needs in wanted.items()]
    apart = " Change one input at a time while the others hold still." if len(wanted) > 1 else ""
    return "Drive " + ". ".join(parts) + "." + apart
