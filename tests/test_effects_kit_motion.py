"""Every built-in effect on the step and on sensors passes the kit that authors of effects get, at several sets of values."""

from s2r_runtime.plugins import registry
from s2r_runtime.testing import EffectKit

VALUES = {
    "viscous_friction": ({"coefficient": 0.6}, {"coefficient_positive": 0.6, "coefficient_negative": 2.0}, {"coefficient": 1e-9}),
    "coulomb_friction": ({"force": 0.3}, {"force_positive": 0.3, "force_negative": 0.1}, {"force": 1e3}),
    "stribeck_friction": (
        {"force": 0.1, "static_force": 0.3, "velocity": 0.2},
        {"force": 0.0, "static_force": 0.3, "velocity": 1e-6},
        {"force": 0.2, "static_force": 0.2, "velocity": 0.2},
    ),
    "cubic_stiffness": ({"coefficient": 2.0}, {"coefficient": -0.5}, {"coefficient": 1e9}),
    "constant_disturbance": ({"x": 0.2, "y": -0.1},),
    "gravity_slope": ({"x": 0.2, "y": -0.1},),
    "lateral_slip": ({"coefficient": -0.1}, {"coefficient": 0.3}),
    "longitudinal_slip": ({"ratio": 0.2}, {"ratio": 1.0}),
    "wheel_radius_scale": ({"left": 1.04, "right": 0.97, "track": 0.4}, {"left": -1.0, "right": 0.0, "track": 0.1}),
    "wheel_slip": ({"left": 0.1, "right": -0.05, "track": 0.4}, {"left": 1.0, "right": 0.0, "track": 0.1}),
    "castor_drag": ({"loss": 0.02, "arm": 0.2}, {"loss": 9.0, "arm": 0.1}),
    "link_gravity": ({"torque": 0.5, "angle": 0.3}, {"torque": 40.0, "angle": -3.0}),
    "torque_ripple": ({"amplitude": 0.3, "period": 0.4, "phase": 1.0}, {"amplitude": 3.0, "period": 9.0, "phase": -2.0}),
    "load_friction": ({"coefficient": 0.2}, {"coefficient": 1.5}),
    "static_friction": ({"force": 0.3, "velocity": 0.2}, {"force": 0.3, "velocity": 1e-6}),
    "track_scale": ({"gain": 0.4}, {"gain": -1.0}),
    "understeer": ({"coefficient": 0.05}, {"coefficient": -0.05}, {"coefficient": -1e3}),
    "rear_slip": ({"coefficient": 0.02}, {"coefficient": -0.02}),
    "position_field": ({"matrix": [[0.1, -0.2], [0.3, 0.05]]}, {"matrix": [[-80.0, 3.0], [0.0, 9.0]]}),
    "mass_change": ({"ratio": 1.3}, {"mass": 0.7}),
    "parameter_change": ({"ratio": 1.3}, {"value": 0.7}),
    "heading_offset": ({"angle": 0.2}, {"angle": -3.1}),
    "sensor_offset": ({"offset": 0.2}, {"offset": -7.0}),
    "sensor_lever_arm": ({"x": 0.1, "y": -0.2},),
    "integration_scheme": ({"scheme": "exact"}, {"scheme": "rk4"}, {"scheme": "euler"}),
}

for _name, (_first, *_others) in VALUES.items():
    _class = f"Test_{_name}"
    globals()[_class] = type(
        _class, (EffectKit,), {"effect": registry().get("effects", _name), "parameters": _first, "others": tuple(_others)}
    )


def test_no_effect_on_motion_or_sensors_is_left_out():
    offered = {name for name in registry().names("effects") if registry().get("effects", name).stage != "input"}
    assert offered == set(VALUES)
