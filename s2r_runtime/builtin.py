"""The built-in models, effects and tasks, offered through the same hooks as anybody's."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl

_MODELS = {
    "unicycle": "planar pose driven by speed and yaw rate (Euler, heading at the start of the step)",
    "differential_drive": "planar pose driven by two wheel speeds",
    "bicycle": "kinematic bicycle about the rear axle",
    "double_integrator": "planar position driven by acceleration",
    "joint": "one joint driven by a force or torque",
}


@hookimpl
def s2r_models() -> list[Offer]:
    """The nominal models of the design."""
    return [Offer(name, f"s2r_runtime.models.{name}:MODEL", summary) for name, summary in _MODELS.items()]


_EFFECTS = {
    "input_gain": "an input acts by a constant factor",
    "input_gain_asymmetry": "an input acts by a factor that depends on its sign",
    "input_bias": "a constant is added to an input",
    "input_delay": "an input acts later",
    "input_lag": "an input is followed with a first-order lag",
    "input_rate_limit": "an input is followed at a limited rate",
    "input_saturation": "an input is clipped",
    "input_gain_drift": "an input's gain drifts with time",
    "regime_change": "an input's gain changes at one time",
    "periodic_disturbance": "a sine is added to an input",
    "input_deadband": "small inputs do nothing",
    "input_backlash": "an input acts through a play",
    "input_coupling": "an input acts on another one too",
    "wheel_saturation": "both wheels of a unicycle are clipped, which couples v and w",
    "viscous_friction": "friction in proportion to speed",
    "coulomb_friction": "dry friction: stops a motion and holds it",
    "constant_disturbance": "a constant push: wind, a current, a cable",
    "stribeck_friction": "dry friction that is larger near standstill",
    "quadratic_drag": "a loss in proportion to speed squared",
    "cubic_stiffness": "a spring that hardens",
    "gravity_slope": "a tilted world: a pull along the body that depends on the heading",
    "lateral_slip": "a turning robot slides sideways",
    "longitudinal_slip": "wheels turn farther than the robot moves",
    "wheel_radius_scale": "the wheels of a differential drive have other radii than the model, or unequal ones",
    "castor_drag": "a castor behind the axle drags and takes off speed",
    "steering_ratio": "the road wheels turn by another ratio than the steering command says",
    "steering_offset": "the road wheels are not straight at a steering command of zero",
    "link_gravity": "gravity on a link that turns about a horizontal axis",
    "torque_ripple": "a force that repeats with the position: a motor's magnets, an eccentric gear",
    "gear_backlash": "no force reaches the link while the motor crosses the backlash of its gear",
    "load_friction": "dry friction of a gear that grows with the transmitted force",
    "static_friction": "what must be overcome near standstill, beyond the friction of a motion",
    "wheel_slip": "each side of a differential drive slips by its own share",
    "track_scale": "yaw is a constant factor of the ideal one: skidding wheels",
    "understeer": "a car turns less the faster it goes",
    "rear_slip": "a car's rear tyres give way in curves, with the speed squared",
    "position_field": "a push that depends linearly on the position",
    "mass_change": "the mass is another one",
    "parameter_change": "a parameter of one's own model is another one",
    "heading_offset": "the heading is measured with a constant offset",
    "sensor_offset": "a state is measured with a constant offset",
    "sensor_lever_arm": "another point of the body is measured",
    "integration_scheme": "the pose moves along arcs, not along the step's first tangent; an own model's steps are too coarse",
}


@hookimpl
def s2r_effects() -> list[Offer]:
    """Effects that a model can lack, one file each."""
    return [Offer(name, f"s2r_runtime.effects.{name}:EFFECT", summary) for name, summary in _EFFECTS.items()]


@hookimpl
def s2r_tasks() -> list[Offer]:
    """Scenario laws with safety metrics."""
    return [
        Offer("grid_world", "s2r_runtime.tasks.grid_world:GridWorld", "the paper's grid with static and moving obstacles"),
        Offer("keep_out", "s2r_runtime.tasks.keep_out:KeepOut", "reach a goal, stay out of a disc"),
        Offer(
            "stl", "s2r_runtime.tasks.stl_task:StlTask", "what the profile says: a formula of signal temporal logic or a barrier function"
        ),
    ]


@hookimpl
def s2r_formats() -> list[Offer]:
    """Formats whose readers need no robot's protocol; their libraries are in the extra `formats`."""
    return [
        Offer("ulog", "s2r_runtime.recordings.formats.ulog:ULogFile", "PX4 ULog, by pyulog"),
        Offer("mdf", "s2r_runtime.recordings.formats.mdf:open_mdf", "MF4 and MDF measurement files, by asammdf"),
        Offer("parquet", "s2r_runtime.recordings.formats.parquet:open_parquet", "Parquet files and LeRobot data sets, by pyarrow"),
        Offer("matlab", "s2r_runtime.recordings.formats.matlab:open_matlab", "MATLAB files up to version 7, by scipy"),
    ]


@hookimpl
def s2r_kits() -> list[Offer]:
    """For those of the above that the kits can't try on values of their own."""
    return [
        Offer("effects.periodic_disturbance", "s2r_runtime.testing.builtin_kits:PeriodicKit"),
        Offer("tasks.stl", "s2r_runtime.testing.builtin_kits:StlKit"),
    ]
