"""Effects that the library does not name, of kinds that the tracer's library of unnamed nonlinearities knows.

For each of them the tracer has the same equation, a basis or a Gaussian-process disturbance. Their seeds are untouched, their kinds are
not: figures on them are in-sample. What each one is stands with it.
"""

from __future__ import annotations

from trace_sets import outside_inputs as on_inputs
from trace_sets import outside_motion as on_motion
from trace_sets.outside_shapes import MASSES, POSES, Kind
from trace_sets.scale import PLANTS

TWO_INPUTS = (*POSES, "double_integrator")

KINDS: dict[str, Kind] = {
    "resonance": Kind(PLANTS, on_inputs.resonance),
    "lazy_when_fast": Kind(PLANTS, on_inputs.lazy_when_fast),
    "uneven_lag": Kind(PLANTS, on_inputs.uneven_lag),
    "bouc_wen": Kind(PLANTS, on_inputs.bouc_wen),
    "sticky": Kind(PLANTS, on_inputs.sticky),
    "exhausted": Kind(PLANTS, on_inputs.exhausted),
    "fade": Kind(PLANTS, on_inputs.fade),
    "cross_square": Kind(TWO_INPUTS, on_inputs.cross_square),
    "cubic": Kind(PLANTS, on_inputs.cubic),
    "coarse": Kind(PLANTS, on_inputs.coarse),
    "ripple": Kind(PLANTS, on_inputs.ripple),
    "lost_commands": Kind(PLANTS, on_inputs.lost_commands),
    "jerk_coupling": Kind(TWO_INPUTS, on_inputs.jerk_coupling),
    "overshoot": Kind(PLANTS, on_inputs.overshoot),
    "slip_patches": Kind(POSES, on_motion.slip_patches),
    "heading_drag": Kind(POSES, on_motion.heading_drag),
    "magnetic_floor": Kind(POSES, on_motion.magnetic_floor),
    "rolling_floor": Kind(POSES, on_motion.rolling_floor),
    "spin_drift": Kind(POSES, on_motion.spin_drift),
    "gusts": Kind(PLANTS, on_motion.gusts),
    "swell": Kind(PLANTS, on_motion.swell),
    "rough_place": Kind(MASSES, on_motion.rough_place),
    "cogging": Kind(MASSES, on_motion.cogging),
    "steep_drag": Kind(MASSES, on_motion.steep_drag),
    "gyroscopic": Kind(("double_integrator",), on_motion.gyroscopic),
    "spring_with_end": Kind(MASSES, on_motion.spring_with_end),
    "gyro_drift": Kind(POSES, on_motion.gyro_drift),
    "lens": Kind(POSES, on_motion.lens),
}
