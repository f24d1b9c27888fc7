"""Which effects are one and the same on a model, so that no data can tell them apart.

| effect | is on | the effect |
| --- | --- | --- |
| `track_scale` gain g | unicycle | `input_gain` of the yaw rate, g |
| `longitudinal_slip` ratio r | unicycle | `input_gain` of the speed, 1 - r |
| `wheel_slip` left, right | two wheels | `wheel_radius_scale` 1 - left, 1 - right |
| `steering_ratio` ratio r | a steering input | `input_gain` of it, r |
| `steering_offset` angle b | a steering input | `input_bias` of it, b |
| `static_friction` force f, velocity | axes | `stribeck_friction`, force 0, static_force f |
| `mass_change` ratio r (mass m r) | joint | `input_gain` of the force, 1/r |
| `parameter_change` ratio r | a model of one's own, where it divides or multiplies one input | `input_gain` of it, r or 1/r |
| `constant_disturbance` world, x | joint | `input_bias` of the force, x |
| `gravity_slope` x, y | axes | `constant_disturbance` world, x, y |
| `sensor_offset` of the heading, b | poses | `heading_offset`, angle b |
| any effect of `*` | one input | the same of that input |

and for some values only (`same` knows them, `canonical` does not):

| `constant_disturbance` body x, y = 0 | unicycle | `input_bias` of the speed, x |
| `constant_disturbance` world with x or y alone | double integrator | `input_bias` of that axis |
| `sensor_lever_arm` y, x = 0 | unicycle on arcs | `input_coupling` of the speed from the yaw rate, -y |
| `stribeck_friction`, static_force = force | axes | `coulomb_friction` |

A bicycle's steering gain and its wheel base, a wheel's gain and `longitudinal_slip` are nearly alike only: tan is no straight line, and the
wheels' speeds are measured too. Some effects are two others (`several`): dry friction of f+ forward and f- backward is (f+ + f-)/2 either
way and a constant push of (f- - f+)/2; a push in the plane is one an axis.

Rows of the table are tried out on the model itself, at random states, since a model may be anybody's; those that hold are kept.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.parameter_change import EFFECT as PARAMETER
from s2r_runtime.errors import ConfigError, PluginError
from s2r_runtime.hookspecs import Effect, NominalModel
from s2r_runtime.models.bound import BoundModel, bind
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.models.forces import axes, mass
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry

Array = NDArray[np.float64]
Values = dict[str, Any]
Named = tuple[str, str, Values]
Convert = Callable[[Values], Values | None]

TRIED, TRIED_DT_S, ALIKE = 12, 0.07, 1e-9
"""Random states on which a row of the table is tried, the step, and what counts as the same, in units of the state."""

FAR = (1.0, 10.0, 100.0)
"""How far from zero states and inputs are on which parameters of one's own model are tried: they may be about an end stop, or a limit."""


@dataclass(frozen=True)
class Row:
    """name on channel is `to` on its channel. there, back: values -> values, None where it is not (there None: not that way).

    always: for all values. example: values at which it is tried.
    """

    name: str
    channel: str
    to: str
    to_channel: str
    there: Convert
    back: Convert
    example: Values
    always: bool = True


def same(model: NominalModel, name: str, channel: str, p: Values) -> list[Named]:
    """All other (name, channel, values) that are the same effect on this model."""
    found: list[Named] = [(name, channel, p)]
    for known in found:
        for other in _neighbours(model, *known):
            if all(other[:2] != f[:2] for f in found):
                found.append(other)
    return found[1:]


def canonical(model: NominalModel, name: str, channel: str) -> tuple[str, str]:
    """The member of the class that a tracer searches, for all values."""
    for row in _rows(model):
        if row.always and (row.name, row.channel) == (name, channel):
            return canonical(model, row.to, row.to_channel)
    return name, channel


def several(model: NominalModel, name: str, channel: str, p: Values) -> list[list[Named]]:
    """Ways in which one effect is several others together."""
    found: list[list[Named]] = []
    if name == "coulomb_friction" and "force_positive" in p:
        mean, push = 0.5 * (p["force_positive"] + p["force_negative"]), 0.5 * (p["force_negative"] - p["force_positive"])
        axis = next((k for k in axes(model) if model.states[k.velocity] == channel), None)
        pushes = registry().get("effects", "constant_disturbance")
        if axis is not None and "world" in pushes.channels(model):
            along = pushes.takes(model, "world")
            here = model.states[axis.position] if len(along) > 1 else along[0]
            constant = ("constant_disturbance", "world", {k: push if k == here else 0.0 for k in along})
            found += [[(name, channel, {"force": mean}), one] for one in [constant, *same(model, *constant)]]
    if name == "stribeck_friction" and 0.0 < p["force"] < p["static_force"]:
        beyond = {"force": p["static_force"] - p["force"], "velocity": p["velocity"]}
        found.append([("coulomb_friction", channel, {"force": p["force"]}), ("static_friction", channel, beyond)])
    if name in {"constant_disturbance", "gravity_slope"} and {"x", "y"} <= set(p):
        parts = [same(model, name, channel, {**dict.fromkeys(p, 0.0), key: p[key]}) for key in p]
        biases = [[one for one in part if one[0] == "input_bias"] for part in parts]
        if all(biases):
            found.append([one[0] for one in biases])
    if name == "wheel_radius_scale" and p["left"] == p["right"]:
        ahead = ("longitudinal_slip", "*", {"ratio": 1.0 - p["left"]})
        turns = ("track_scale", "theta", {"gain": p["left"]})
        found += [[one, two] for one in (ahead, *same(model, *ahead)) for two in (turns, *same(model, *turns))]
    if channel == "*" and name in {"input_delay", "input_gain_drift", "regime_change"} and len(model.inputs) > 1:
        found.append([(name, single, dict(p)) for single in model.inputs])
    return found


def _neighbours(model: NominalModel, name: str, channel: str, p: Values) -> Iterator[Named]:
    """One row away."""
    for row in _rows(model):
        if (row.name, row.channel) == (name, channel) and (values := row.there(p)) is not None and _allowed(row.to, values):
            yield row.to, row.to_channel, values
        if (row.to, row.to_channel) == (name, channel) and (values := row.back(p)) is not None and _allowed(row.name, values):
            yield row.name, row.channel, values


def _allowed(name: str, p: Values) -> bool:
    """Whether the values are within the effect's bounds."""
    bounds = {q.name: q for q in registry().get("effects", name).parameters}
    return all(not isinstance(v, float) or bounds[k].low <= v <= bounds[k].high for k, v in p.items())


_KNOWN: WeakKeyDictionary[BoundModel, tuple[Row, ...]] = WeakKeyDictionary()


def _rows(model: NominalModel) -> tuple[Row, ...]:
    """Rows that hold on this model."""
    bound = model if isinstance(model, BoundModel) else None
    if bound is not None and bound in _KNOWN:
        return _KNOWN[bound]
    at = bound if bound is not None else bind(model, {})
    rows = tuple(row for row in _proposed(at) if _holds(at, row))
    if bound is not None:
        _KNOWN[bound] = rows
    return rows


def _proposed(model: BoundModel) -> Iterator[Row]:
    """All rows that could hold, by the names of channels."""
    changeable = [name for name in PARAMETER.channels(model) if model.parameters[name]]
    along = registry().get("effects", "constant_disturbance").takes(model, "world")
    for i in model.inputs:
        yield Row("track_scale", "theta", "input_gain", i, _renamed("gain", "gain"), _renamed("gain", "gain"), {"gain": 0.7})
        yield Row("longitudinal_slip", "*", "input_gain", i, _slip_to_gain, _gain_to_slip, {"ratio": 0.3})
        yield Row("steering_ratio", i, "input_gain", i, _renamed("ratio", "gain"), _renamed("gain", "ratio"), {"ratio": 0.7})
        yield Row("steering_offset", i, "input_bias", i, _renamed("angle", "bias"), _renamed("bias", "angle"), {"angle": 0.2})
        for name in changeable:
            for to_gain, from_gain in ((_ratio_to_gain, _gain_to_ratio), (_ratio_to_inverse, _gain_to_mass)):
                yield Row("parameter_change", name, "input_gain", i, to_gain, from_gain, {"ratio": 1.4})
        yield Row("mass_change", "*", "input_gain", i, _mass_to_gain(model), _gain_to_mass, {"ratio": 1.4})
        if "y" not in along:
            yield Row("constant_disturbance", "world", "input_bias", i, _renamed("x", "bias"), _renamed("bias", "x"), {"x": 0.3})
        for key in along if "y" in along else ():
            rest = dict.fromkeys(along, 0.0)
            for channel in ("world", "body"):
                yield Row(
                    "constant_disturbance", channel, "input_bias", i, _alone(key), _alone_back(key, rest), {**rest, key: 0.3}, always=False
                )
        for j in model.inputs:
            if j != i and model.integration == "exact":
                there, back = _arm_to_coupling(j), _coupling_to_arm(j)
                yield Row("sensor_lever_arm", "*", "input_coupling", i, there, back, {"x": 0.0, "y": 0.3}, always=False)
    for late, name in enumerate(changeable):  # two that stand in the model as a product or a ratio only
        for other in changeable[:late]:
            yield Row("parameter_change", name, "parameter_change", other, dict, dict, {"ratio": 1.4})
            yield Row("parameter_change", name, "parameter_change", other, _inverse, _inverse, {"ratio": 1.4})
    slips = dict.fromkeys(registry().get("effects", "wheel_slip").takes(model, "*"), 0.3)
    yield Row("wheel_slip", "*", "wheel_radius_scale", "*", _slips_to_radii, _slips_to_radii, {**slips, "right": -0.2})
    yield Row("gravity_slope", "*", "constant_disturbance", "world", dict, dict, dict.fromkeys(along, 0.3))
    yield Row(
        "sensor_offset", "theta", "heading_offset", "theta", _renamed("offset", "angle"), _renamed("angle", "offset"), {"offset": 0.3}
    )
    for axis in axes(model):
        v = model.states[axis.velocity]
        yield Row("static_friction", v, "stribeck_friction", v, _beyond_none, _without_force, {"force": 0.3, "velocity": 0.1})
        curve = {"force": 0.2, "static_force": 0.2, "velocity": 0.1}
        yield Row("stribeck_friction", v, "coulomb_friction", v, _flat, lambda p: None, curve, always=False)
    yield from _all_alike(model)
    yield from _said_by_themselves(model)


def _all_alike(model: BoundModel) -> Iterator[Row]:
    """All inputs are one input."""
    for name, effect in _effects() if len(model.inputs) == 1 else ():
        if effect.stage == "input" and {"*", model.inputs[0]} <= {*effect.channels(model)}:
            yield Row(name, "*", name, model.inputs[0], dict, dict, {})


def _said_by_themselves(model: BoundModel) -> Iterator[Row]:
    """What effects of others say of themselves (`same_as`)."""
    for name, effect in _effects():
        if hasattr(effect, "same_as"):
            for channel in effect.channels(model):
                for to, to_channel, convert in effect.same_as(model, channel):
                    yield Row(name, channel, to, to_channel, convert, lambda p: None, {})


def _effects() -> Iterator[tuple[str, Effect]]:
    """All that can be loaded."""
    for name in registry().names("effects"):
        with contextlib.suppress(PluginError):
            yield name, registry().get("effects", name)


def _holds(model: BoundModel, row: Row) -> bool:
    """Whether both effects make the same, and something, of random states and inputs. A row without an example is taken at its word."""
    if not row.example:
        return True
    try:
        effects = [registry().get("effects", name) for name in (row.name, row.to)]
    except PluginError:
        return False
    if any(channel not in e.channels(model) for e, channel in zip(effects, (row.channel, row.to_channel), strict=True)):
        return False
    values = row.there(row.example)
    if values is None:
        return False
    first, second = (
        AppliedEffect(effect, channel, p)
        for effect, channel, p in zip(effects, (row.channel, row.to_channel), (row.example, values), strict=True)
    )
    rng, acts = np.random.default_rng(0), False
    for far in FAR if row.name == PARAMETER.name else FAR[:1]:
        x = rng.uniform(-far, far, (TRIED, len(model.states)))
        u = rng.uniform(-far, far, (TRIED, len(model.inputs)))
        try:
            one, other, usual = (_stepped(model, x, u, chain) for chain in ((first,), (second,), ()))
        except ConfigError:  # a user's model that cannot be stepped just anywhere
            return acts
        if not np.all(np.abs(one - other) < ALIKE * np.maximum(1.0, np.abs(usual))):
            return False
        acts = acts or bool(np.any(np.abs(one - usual) > ALIKE))
    return acts


def _stepped(model: BoundModel, x: Array, u: Array, chain: tuple[AppliedEffect, ...]) -> Array:
    """A step from rest with these effects, (n, nx)."""
    scheme = (AppliedEffect(registry().get("effects", "integration_scheme"), "*", {"scheme": model.integration}),)
    shared = replace(model, integration=getattr(model.shared, "integration", ""))
    composed = ComposedModel(
        ModelSpec(model.name, TRIED_DT_S), shared, (*chain, *(scheme if model.integration in {"exact", "rk4"} else ()))
    )
    return composed.step(x, u, composed.at_rest(len(x)))[0]


# ---------------------------------------------------------------- conversions of values


def _renamed(old: str, new: str) -> Convert:
    return lambda p: {new: p[old]}


def _slip_to_gain(p: Values) -> Values:
    return {"gain": 1.0 - p["ratio"]}


def _gain_to_slip(p: Values) -> Values:
    return {"ratio": 1.0 - p["gain"]}


def _slips_to_radii(p: Values) -> Values:
    """And back."""
    return {**p, "left": 1.0 - p["left"], "right": 1.0 - p["right"]}


def _mass_to_gain(model: NominalModel) -> Convert:
    return lambda p: {"gain": 1.0 / p["ratio"] if "ratio" in p else mass(model) / p["mass"]}


def _gain_to_mass(p: Values) -> Values | None:
    return {"ratio": 1.0 / p["gain"]} if p["gain"] > 0.0 else None


def _ratio_to_gain(p: Values) -> Values | None:
    return {"gain": p["ratio"]} if "ratio" in p else None


def _ratio_to_inverse(p: Values) -> Values | None:
    return {"gain": 1.0 / p["ratio"]} if "ratio" in p else None


def _gain_to_ratio(p: Values) -> Values | None:
    return {"ratio": p["gain"]} if p["gain"] > 0.0 else None


def _inverse(p: Values) -> Values | None:
    return {"ratio": 1.0 / p["ratio"]} if "ratio" in p else None


def _alone(key: str) -> Convert:
    return lambda p: {"bias": p[key]} if key in p and not any(v for k, v in p.items() if k != key) else None


def _alone_back(key: str, rest: Values) -> Convert:
    return lambda p: {**rest, key: p["bias"]}


def _arm_to_coupling(other: str) -> Convert:
    return lambda p: {"from": other, "coefficient": -p["y"]} if p["x"] == 0.0 else None


def _coupling_to_arm(other: str) -> Convert:
    return lambda p: {"x": 0.0, "y": -p["coefficient"]} if p["from"] == other else None


def _beyond_none(p: Values) -> Values:
    """Static friction beyond a dry friction of zero."""
    return {"force": 0.0, "static_force": p["force"], "velocity": p["velocity"]}


def _without_force(p: Values) -> Values | None:
    """Stribeck's curve as static friction alone."""
    return {"force": p["static_force"], "velocity": p["velocity"]} if p["force"] == 0.0 else None


def _flat(p: Values) -> Values | None:
    return {"force": p["force"]} if p["force"] == p["static_force"] else None
