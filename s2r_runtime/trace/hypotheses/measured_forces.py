"""Forces that were measured, and not commanded: a motor's current, as a torque, beside the motion that a position loop made.

A command is known, and what the motion says of it is asked of the motion: p(y | u). Of a measurement u = u* + e, with u* the force that
the motion takes, it is the other way round: p(u | y). Asked as if it were a command, noise in it is a force that the robot did not follow,
and the likeliest model has next to none of it (attenuation; W. Fuller, Measurement error models, 1987): friction that takes up the
whole torque of a joint comes out as a gain of 0.03. Where nothing acts on the input, both are the same likelihood, since a force moves the
robot by a known amount:

    y_{k+1} (-) f(y_k, u_k) = -B e_k + noise,      B of the nominal model

so only effects on the motion are offered then (and a constant force), and nothing of what is left is asked about the inputs, with which the
noise goes. `measured_inputs` says when.
"""

from __future__ import annotations

from s2r_runtime.models.composed import ComposedModel

CONSTANT = "input_bias"
"""The effect on an input that a force beside it may be, too."""


def on_motion(model: ComposedModel, name: str, stage: str, channel: str) -> bool:
    """Whether an effect acts on the motion, and not on what moves it."""
    return stage != "input" or channel not in {"*", *model.inputs} or name == CONSTANT


def about_inputs(model: ComposedModel, token: str) -> bool:
    """Whether what is left would depend on an input."""
    return any(name in model.inputs for name in token.replace("memory(", "").replace(")", "").split("*"))
