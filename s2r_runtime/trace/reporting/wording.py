"""Meaning of an effect for the robot, one clause with its parameters: `w does 80 % of what is commanded`.

For an effect of a plug-in the clause is the summary of its offer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from s2r_runtime.errors import PluginError
from s2r_runtime.plugins import registry

Values = Mapping[str, Any]

RIGHT_ANGLE = math.pi / 2.0


def in_words(name: str, channel: str, p: Values) -> str:
    """One clause without a full stop. p: parameter values."""
    what = "every input" if channel == "*" else channel
    clause = _WORDS.get(name)
    if clause is None:
        return _offered(name)
    try:
        return clause(what, p)
    except (KeyError, TypeError, ValueError):  # other parameters than these: of a later version, or one of a pair
        return _offered(name)


def degrees(unit: str) -> str:
    """The same unit in degrees; empty if it is not in radians."""
    return "deg" + unit[3:] if unit in {"rad", "rad/s", "rad/s²", "rad/m"} else ""


def _offered(name: str) -> str:
    try:
        return registry().offered("effects", name).offer.summary
    except PluginError:
        return ""


def _percent(ratio: float) -> str:
    return f"{100.0 * ratio:.3g} %"


UNITS, JUST = ((1.0 / 3.6, "km/h"), (math.pi / 30.0, "rpm"), (math.pi / 180.0, "degrees"), (1e-3, "thousandths")), 3e-3
"""Factor of a unit in which commands may be, by mistake, and relative tolerance of the gain that shows it."""


def _gain(what: str, p: Values) -> str:
    unit = next((f" (is it commanded in {unit}?)" for factor, unit in UNITS if abs(p["gain"] / factor - 1.0) < JUST), "")
    return f"{what} does {_percent(p['gain'])} of what is commanded{unit}"


def _way(value: float) -> str:
    return "more" if value > 0.0 else "less"


def _delay(what: str, p: Values) -> str:
    return f"{what} acts with a delay of {p['delay']:.3g} s"


def _saturation(what: str, p: Values) -> str:
    ends = [f"{side} {p[key]:.3g}" for key, side in (("low", "below"), ("high", "above")) if key in p]
    return f"{what} is cut off {' and '.join(ends)}"


def _friction(kind: str) -> Callable[[str, Values], str]:
    return lambda what, p: f"{kind} brakes {what}" + (", not alike in both directions" if len(p) == 2 else "")


def _mass(what: str, p: Values) -> str:
    return f"the mass is {p['mass']:.4g} kg" if "mass" in p else f"the mass is {_percent(p['ratio'])} of the model's"


def _parameter(what: str, p: Values) -> str:
    return f"{what} is {_percent(p['ratio'])} of the model's value" if "ratio" in p else f"{what} is {p['value']:.4g}, not 0"


def _disturbance(what: str, p: Values) -> str:
    frame = {"world": "in a fixed direction of the world (wind, current)", "body": "in a fixed direction of the robot"}
    return f"something pushes steadily {frame.get(what, '')}".rstrip()


_WORDS: dict[str, Callable[[str, Values], str]] = {
    "input_gain": _gain,
    "input_gain_asymmetry": lambda what, p: (
        f"{what} does {_percent(p['gain_positive'])} of a positive command, {_percent(p['gain_negative'])} of a negative one"
    ),
    "input_bias": lambda what, p: f"{what} is always {abs(p['bias']):.3g} {_way(p['bias'])} than commanded",
    "input_delay": _delay,
    "input_lag": lambda what, p: f"{what} follows its command slowly: 63 % of a step after {p['time_constant']:.3g} s",
    "input_rate_limit": lambda what, p: f"{what} changes by at most {p['rate']:.3g} per second",
    "input_saturation": _saturation,
    "wheel_saturation": lambda what, p: f"no wheel runs faster than {p['speed']:.3g} m/s, which couples v and w",
    "input_deadband": lambda what, p: f"nothing happens below {p['width']:.3g} of {what}, and that much is lost above",
    "input_backlash": lambda what, p: f"{what} has a backlash of {p['width']:.3g} at reversals",
    "input_coupling": lambda what, p: f"{what} also gets {p['coefficient']:.3g} times {p['from']}",
    "input_gain_drift": lambda what, p: f"the gain of {what} changes by {_percent(60.0 * p['rate'])} a minute",
    "regime_change": lambda what, p: f"from {p['time']:.4g} s on {what} does {_percent(p['gain'])} of what is commanded",
    "periodic_disturbance": lambda what, p: f"{what} swings by {p['amplitude']:.3g}, once in {1.0 / p['frequency']:.3g} s",
    "integration_scheme": lambda what, p: {
        "exact": "the robot follows arcs, the model uses Euler integration",
        "rk4": "the model's integration is coarser than the motion",
        "euler": "the robot moves in straight pieces, as under Euler integration",
    }[p["scheme"]],
    "steering_ratio": lambda what, p: f"the road wheels turn by {_percent(p['ratio'])} of {what}",
    "steering_offset": lambda what, p: f"the road wheels are turned by {math.degrees(p['angle']):.3g} deg where {what} is zero",
    "castor_drag": lambda what, p: (
        f"a castor, or a wheel that skids, drags over the floor {p['arm']:.3g} m from the axle and takes {p['loss']:.3g} m/s off the speed"
    ),
    "link_gravity": lambda what, p: f"gravity pulls the link to {what} = {p['angle']:.3g}",
    "torque_ripple": lambda what, p: f"a force of {p['amplitude']:.3g} repeats with every {p['period']:.3g} of {what}",
    "gear_backlash": lambda what, p: f"after a reversal {what} acts only when the motor has crossed the backlash of its gear",
    "load_friction": lambda what, p: f"friction takes {_percent(p['coefficient'])} of the transmitted force off {what}",
    "static_friction": lambda what, p: f"friction near standstill holds {what}",
    "viscous_friction": _friction("friction that grows with speed"),
    "coulomb_friction": _friction("dry friction of a constant size"),
    "stribeck_friction": _friction("dry friction that is larger at standstill"),
    "quadratic_drag": lambda what, p: f"drag that grows with the square of {what}",
    "cubic_stiffness": lambda what, p: f"a spring on {what} that {'stiffens' if p['coefficient'] > 0.0 else 'gives way'} with the cube",
    "constant_disturbance": _disturbance,
    "gravity_slope": lambda what, p: "the ground slopes: its force turns with the heading",
    "lateral_slip": lambda what, p: "the robot slides sideways in curves",
    "longitudinal_slip": lambda what, p: f"the wheels slip: {_percent(p['ratio'])} of the displacement is lost",
    "wheel_radius_scale": lambda what, p: (
        f"the left wheel has {_percent(p['left'])} of the model's radius, the right one {_percent(p['right'])}"
    ),
    "wheel_slip": lambda what, p: f"the left wheel slips by {_percent(p['left'])}, the right one by {_percent(p['right'])}",
    "track_scale": lambda what, p: f"it turns at {_percent(p['gain'])} of the ideal rate",
    "understeer": lambda what, p: f"it turns {'less' if p['coefficient'] > 0.0 else 'more'} than commanded, with the speed squared",
    "rear_slip": lambda what, p: (
        f"its rear axle slides {'outwards' if p['coefficient'] > 0.0 else 'inwards'} in curves, with the speed squared: tyres slip"
    ),
    "heading_offset": lambda what, p: f"the measured heading is off by {math.degrees(p['angle']):.3g} deg",
    "sensor_offset": lambda what, p: f"{what} is measured {abs(p['offset']):.3g} too {'high' if p['offset'] > 0.0 else 'low'}",
    "sensor_lever_arm": lambda what, p: f"the sensor is {1000.0 * math.hypot(p['x'], p['y']):.3g} mm from the model's reference point",
    "position_field": lambda what, p: "something pushes that depends on where the robot is",
    "mass_change": _mass,
    "parameter_change": _parameter,
}
