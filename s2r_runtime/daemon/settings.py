"""Profile -> the core's settings, without loading a model: what only the model knows comes as `ModelFacts`.

The model's own module imports numpy, 20 MB that the daemon's process can do without. Its analytics process loads the model
anyhow and tells the facts when it starts.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.files.canonical import digest_of
from s2r_runtime.messages import EPISODES, GRID, IMPLAUSIBLE, RULES, Gap, Settings
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Profile, plain_table
from s2r_runtime.profile.settings import AS_BEFORE

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel


FENCES = 2.0
"""A robot may be a little outside, and so may the prediction."""


class ModelFacts(msgspec.Struct, frozen=True):
    """A model's names, in order; `angles` are the states that wrap. `horizon`: steps of the profile's task. `any_step`: see `Settings`."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    horizon: int = 0
    any_step: bool = False

    def same_robot(self, other: ModelFacts) -> bool:
        """Whether two models are of one robot: all but how they step."""
        return msgspec.structs.replace(self, any_step=other.any_step) == other


def facts_of(model: ComposedModel, horizon: int = 0) -> ModelFacts:
    """What there is to know of a model. horizon: of the profile's task."""
    return ModelFacts(model.states, model.inputs, tuple(model.nominal.angles), horizon, model.any_step)


def fence_of(profile: Profile, angles: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """By state. An angle without bounds may be anything in its circle; a state that the geofence doesn't name is fenced by the region."""
    return {**dict.fromkeys(angles, (-math.pi, math.pi)), **profile.region, **profile.geofence}


def fault_jump_of(profile: Profile, states: tuple[str, ...], angles: tuple[str, ...], gap: Gap, rules: int = RULES) -> float:
    """Above which a discrepancy is a fault of measurement, in the gap's norm; 0: nothing is.

    The profile's `watch.fault_jump`; where that is 0, `FENCES` times the norm of the geofence's extent: a robot inside it, and a model that
    predicts from there, are no farther apart.
    """
    if profile.watch.fault_jump > 0.0 or rules < IMPLAUSIBLE:
        return profile.watch.fault_jump
    fence = fence_of(profile, angles)
    apart = [min(high - low, math.pi) if name in angles else high - low for name in states for low, high in (fence[name],)]
    weighted = [w * d for w, d in zip(gap.weights, apart, strict=True)]
    return FENCES * (max(weighted) if gap.set == "box" else math.hypot(*weighted))


def settings_of(
    profile: Profile,
    model: ModelSpec,
    facts: ModelFacts,
    seed: int | None = None,
    rules: int = RULES,
    *,
    simulated: bool = False,
) -> Settings:
    """What the profile fixes for the core. model: the one in force (the profile's, or one adopted since). seed: instead of the
    profile's. rules: those that the run was made under. simulated: whether seeds of verifications are fixed.

    An angle without bounds may be anything in its circle. A state that the geofence doesn't name is fenced by the region.
    """
    gate, recovery = profile.gate, profile.recovery
    circle = dict.fromkeys(facts.angles, (-math.pi, math.pi))
    region = {**circle, **profile.region}
    fence = fence_of(profile, facts.angles)
    held = recovery.input if recovery.kind == "hold" else {}
    runs: dict[str, Any] = {}
    if rules >= EPISODES:
        about = profile.guarantee
        runs = {"beta_episodes": about.beta_episodes, "max_unsafe": about.max_unsafe, "gate_closing": about.gate_closing}
        runs["threshold"] = profile.verification.threshold
    if profile.verification.run_radius > 0.0:
        runs["run_radius"] = profile.verification.run_radius
    return Settings(
        robot=profile.robot.name,
        states=facts.states,
        inputs=facts.inputs,
        angles=facts.angles,
        dt_ns=round(model.dt * 1e9),
        lockstep=profile.clock == "lockstep",
        region=tuple(region[name] for name in facts.states),
        geofence=tuple(fence[name] for name in facts.states),
        input_bounds=tuple(profile.inputs[name] for name in facts.inputs),
        observation_timeout_ns=round(gate.observation_timeout * 1e9),
        command_ttl_ns=round(gate.command_ttl * 1e9),
        hysteresis_ns=round(gate.hysteresis * 1e9),
        settle_periods=gate.settle_periods,
        latching=gate.latching,
        recovery=recovery.kind,
        recovery_input=tuple(float(held.get(name, 0.0)) for name in facts.inputs),
        home=tuple(float(recovery.home.get(name, 0.0)) for name in facts.states),
        model_name=model.name,
        model_digest=model.digest(),
        task_digest=profile.task_digest(),
        profile_digest=profile.digest(),
        epsilon=profile.guarantee.epsilon,
        beta=profile.guarantee.beta,
        discard=profile.guarantee.discard,
        campaign_n=profile.sampling.n,
        headroom=profile.verification.headroom,
        alpha=profile.guarantee.alpha,
        max_measurement_faults=profile.watch.max_faults,
        certificate_lifetime_s=round(profile.certificate.lifetime),
        seed=profile.sampling.seed if seed is None else seed,
        trace_after_campaign=profile.repair.after_campaign,
        trace_after_inputs=profile.repair.after_inputs,
        trace_on_growth=profile.repair.on_growth,
        trace_delay_ns=round(profile.repair.delay * 1e9),
        trace_rows=profile.repair.rows,
        adopt=profile.repair.adopt,
        required_laws=profile.verification.required,
        campaign_digest=campaign_digest(profile),
        run_length=profile.watch.run_length,
        norm_set=profile.norm.set,
        norm_weights=tuple(profile.norm.weights.get(name, 1.0) for name in facts.states),
        fault_share=gate.fault_share,
        fault_burst=gate.fault_burst,
        rules=rules,
        any_step=facts.any_step and rules >= GRID,
        simulated=simulated,
        **runs,
    )


TICK_S = 0.02
"""Of the daemon's loop."""
LOCKSTEP_DISK_S = 30.0
"""There nothing moves while the disk is waited for. Four times the slowest sync that was seen on a busy disk (7.1 s)."""


def disk_timeout_s(profile: Profile) -> float:
    """For how long the loop may wait for the disk, s."""
    set_s = profile.machine.disk_timeout
    return max(set_s, LOCKSTEP_DISK_S) if profile.clock == "lockstep" else set_s


def controller_deadline_s(profile: Profile) -> float:
    """How long a controller may take for an answer, s. In lockstep the robot waits for it, so only one that hangs is ended.

    In real time the core gives an answer up after `gate.command_ttl`, whoever is to blame; the daemon, which knows, comes a tick before.
    """
    set_s, ttl_s = profile.gate.controller_deadline, profile.gate.command_ttl
    if profile.clock == "lockstep":
        return max(set_s, profile.machine.process_timeout)
    return min(set_s, max(ttl_s - TICK_S, 0.5 * ttl_s))


def campaign_digest(profile: Profile) -> str:
    """Digest of what a gap rests on besides the model: the law of the samples, the norm, and what was fixed beforehand."""
    sampling = plain_table("sampling", profile.sampling)
    guarantee = {name: value for name, value in msgspec.to_builtins(profile.guarantee).items() if name not in AS_BEFORE["guarantee"]}
    tables = (profile.region, profile.geofence, profile.inputs, profile.norm, sampling, guarantee)
    return digest_of([msgspec.to_builtins(table) for table in tables])
