"""Promises of the example controllers: on the built-in robot's gap the good ones pass and the reckless one can't, and a robot that
is not as its data sheet says gets the good one refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.evidence.bounds import attempt_beta, clopper_pearson_upper, epoch_beta, sample_size
from s2r_runtime.evidence.gap import estimate_gap
from s2r_runtime.evidence.uncertain import GapSet, roll_out
from s2r_runtime.evidence.verify import seed_for, verify
from s2r_runtime.messages import Gap, Verification
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec
from s2r_runtime.plugins import registry
from s2r_runtime.profile import load_profile
from s2r_runtime.recordings.transitions import Transitions
from s2r_runtime.tasks.grid_world import GridWorld
from s2r_runtime.tasks.keep_out import KeepOut

ROOT = Path(__file__).parent.parent
PROFILE = load_profile(ROOT / "profiles" / "robotarium.toml")
MODEL = compose(PROFILE.model)
WEIGHTS = tuple(PROFILE.norm.weights.get(name, 1.0) for name in MODEL.states)
NOISE = np.array([0.0002, 0.0002, 0.001])
"""The built-in robot's measurements, m and rad."""
NAMES = ("grid", "grid_reckless", "keep_out")


def controller(name: str) -> Any:
    return batch_control(load(ROOT / "controllers" / f"{name}.py"), 2)


def effect(name: str, channel: str, **parameters: float) -> EffectSpec:
    return EffectSpec(name, channel, parameters)


def robot(*undeclared: EffectSpec) -> ComposedModel:
    """The data sheet's robot with effects that its model doesn't know: they act on the command before its wheels do."""
    spec = PROFILE.model
    return compose(msgspec.structs.replace(spec, effects=(*undeclared, *spec.effects)))


def campaign(*undeclared: EffectSpec, seed: int) -> Gap:
    """The gap of the profile's model on a campaign of that robot, as epoch 1 of its life."""
    rng, true = np.random.default_rng(seed), robot(*undeclared)
    beta, hold = epoch_beta(PROFILE.guarantee.beta, 1), PROFILE.sampling.hold_periods
    n = sample_size(PROFILE.guarantee.epsilon, beta / 2.0)
    x0 = np.stack([rng.uniform(-1.3, 1.3, n), rng.uniform(-0.7, 0.7, n), rng.uniform(-np.pi, np.pi, n)], axis=1)
    u = np.stack([rng.uniform(*PROFILE.inputs[name], n) for name in MODEL.inputs], axis=1)

    def measured(x: np.ndarray) -> np.ndarray:
        return x + NOISE * rng.standard_normal((n, 3))

    transitions = Transitions(
        x0=measured(x0),
        u=u,
        x1=measured(true.hold(x0, u, 1)),
        held=measured(true.hold(x0, u, hold)),
        hold_periods=hold,
        independent=True,
        rejected={},
        digest="sha256:none",
        t0_s=np.arange(n) * 10.0,
        source="in-process campaign",
    )
    return estimate_gap(MODEL, transitions, epsilon=PROFILE.guarantee.epsilon, beta=beta, kind="ball", weights=WEIGHTS)


def verified(name: str, gap: Gap, attempt: int = 1) -> Verification:
    """As the daemon does it: at the headroom, with the attempt's share of beta and its seed."""
    file, wanted = load(ROOT / "controllers" / f"{name}.py"), PROFILE.verification
    task = registry().get("tasks", PROFILE.task.name)(PROFILE.task.parameters, MODEL.nominal, MODEL.dt)
    return verify(
        batch_control(file, 2),
        task,
        MODEL,
        gap_set=GapSet("ball", WEIGHTS, wanted.headroom * gap.radius, wanted.headroom * gap.hold_radius, gap.hold_periods),
        laws=wanted.required,
        required=wanted.required,
        n=0,
        epsilon=wanted.epsilon,
        beta=attempt_beta(PROFILE.guarantee.beta, attempt),
        threshold=wanted.threshold,
        seed=seed_for(file.digest, MODEL.spec.digest(), PROFILE.task_digest(), attempt),
        attempt=attempt,
        controller_digest=file.digest,
        task_digest=PROFILE.task_digest(),
    )


# ---------------------------------------------------------------- the loop's promise


@pytest.mark.slow
def test_on_the_robot_as_declared_the_good_controller_passes_and_the_reckless_one_does_not() -> None:
    for seed in range(3):
        gap = campaign(seed=seed)
        assert gap.radius < 0.0015
        assert gap.hold_radius < 0.002
        good, reckless = verified("grid", gap, seed + 1), verified("grid_reckless", gap, seed + 1)
        assert good.passed, good.reason
        assert not reckless.passed
        assert all(law.failures > 0.2 * law.n for law in reckless.laws)


UNDECLARED = {
    "w gain 0.7": effect("input_gain", "w", gain=0.7),
    "w gain 1.3": effect("input_gain", "w", gain=1.3),
    "v gain 0.8": effect("input_gain", "v", gain=0.8),
    "v gain 0.9": effect("input_gain", "v", gain=0.9),
    "w bias 0.3": effect("input_bias", "w", bias=0.3),
    "lag 0.3 s of w": effect("input_lag", "w", time_constant=0.3),
    "delay 0.2 s more": effect("input_delay", "*", delay=0.2),
}


@pytest.mark.parametrize("name", UNDECLARED)
def test_an_undeclared_effect_leaves_a_gap_at_which_the_good_controller_is_refused(name: str) -> None:
    gap = campaign(UNDECLARED[name], seed=11)
    assert gap.hold_radius > 0.02
    result = verified("grid", gap)
    assert not result.passed
    # the first step after a full stop shows nothing of the inputs: only a push that lasts does
    assert result.reason.startswith("under persistent")


# ---------------------------------------------------------------- each on its own


def gap_set(times: float) -> GapSet:
    gap = campaign(seed=21)
    return GapSet("ball", WEIGHTS, times * gap.radius, times * gap.hold_radius, gap.hold_periods)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["uniform", "persistent"])
def test_the_grid_controller_fails_less_than_once_in_a_thousand_at_the_headroom(law: str) -> None:
    task = GridWorld(PROFILE.task.parameters, MODEL.nominal, MODEL.dt)
    n = 20_000
    done = roll_out(controller("grid"), task, MODEL, gap_set(1.5), law, np.random.default_rng([31, len(law)]), n)
    assert clopper_pearson_upper(int(np.sum(done.safety < 0.0)), n, 1e-3) < 1e-3
    assert np.median(done.progress) >= 0.79


@pytest.mark.slow
def test_the_grid_controller_holds_out_against_the_adversary_too() -> None:
    task = GridWorld(PROFILE.task.parameters, MODEL.nominal, MODEL.dt)
    done = roll_out(controller("grid"), task, MODEL, gap_set(1.5), "adversarial", np.random.default_rng(32), 5000)
    assert clopper_pearson_upper(int(np.sum(done.safety < 0.0)), 5000, 1e-3) < 5e-3


@pytest.mark.parametrize("law", ["uniform", "persistent", "adversarial"])
def test_the_keep_out_controller_fails_less_than_once_in_two_hundred(law: str) -> None:
    task = KeepOut({}, MODEL.nominal, MODEL.dt)
    done = roll_out(controller("keep_out"), task, MODEL, gap_set(1.5), law, np.random.default_rng([33, len(law)]), 3000)
    assert clopper_pearson_upper(int(np.sum(done.safety < 0.0)), 3000, 1e-3) < 5e-3
    assert task.progress_ok(done.progress)


@pytest.mark.parametrize("name", NAMES)
def test_a_controller_answers_each_rollout_as_if_it_were_alone(name: str) -> None:
    task = (KeepOut if name == "keep_out" else GridWorld)({}, MODEL.nominal, MODEL.dt)
    control, rng = controller(name), np.random.default_rng(34)
    scenario = task.draw(rng, 40)
    theta = task.view(scenario)
    together = control(scenario["start"], theta)
    low, high = np.array([PROFILE.inputs[name] for name in MODEL.inputs]).T
    assert np.all((together >= low) & (together <= high))
    for i in range(40):
        alone = control(scenario["start"][i : i + 1], {key: value[i : i + 1] for key, value in theta.items()})
        assert np.allclose(alone[0], together[i], rtol=1e-12, atol=1e-12)


def test_the_grid_controller_drives_the_quadruped_s_grid_without_movers() -> None:
    task = GridWorld({"columns": 5, "rows": 5, "static": 5, "goals": 1, "movers": 0}, MODEL.nominal, MODEL.dt)
    done = roll_out(controller("grid"), task, MODEL, gap_set(1.0), "uniform", np.random.default_rng(35), 1000)
    assert np.mean(done.safety < 0.0) < 0.01
    assert np.median(done.progress) > 0.0


@pytest.mark.parametrize("name", ["grid", "grid_reckless"])
def test_a_controller_keeps_its_wits_outside_the_arena(name: str) -> None:
    task = GridWorld({}, MODEL.nominal, MODEL.dt)
    scenario = task.draw(np.random.default_rng(36), 5)
    x = np.array([[5.0, 0.0, 0.0], [-5.0, -5.0, 1.0], [1.61, 1.01, 2.0], [-1.6, -1.0, 3.0], [1.6, 1.0, -3.0]])
    assert np.all(np.isfinite(controller(name)(x, task.view(scenario))))
