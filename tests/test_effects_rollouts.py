"""Models with effects in the uncertain model's rollouts and in a verification: hidden states are from rest, and each rollout's own."""

import numpy as np
import pytest
from effects_rig import VALUES

from s2r_runtime.evidence.uncertain import GapSet, roll_out
from s2r_runtime.evidence.verify import verify
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.tasks.keep_out import KeepOut

DT = 0.1
GAP = GapSet("ball", (1.0, 1.0, 0.05), 1e-9)


def _model(name, p):
    effects = () if not name else (EffectSpec(name, "*" if name == "wheel_saturation" else "w", {**p, "from": "v"} if "from" in p else p),)
    return compose(ModelSpec("unicycle", DT, {}, effects))


def _weaving(x, theta):
    """Depends on the state alone: a rollout sees nothing of its neighbours."""
    return np.column_stack([np.full(len(x), 0.2), 1.5 * np.sin(9.0 * x[:, 0] + 5.0 * x[:, 1])])


@pytest.mark.parametrize("name", VALUES)
def test_a_rollout_among_many_is_what_stepping_it_alone_gives(name):
    for p in VALUES[name]:
        model = _model(name, p)
        task = KeepOut({"steps": 30}, model.nominal, DT)
        paths = roll_out(_weaving, task, model, GAP, "uniform", np.random.default_rng(5), 12, keep=12).paths
        for path in paths[::5]:
            x, hidden = path[:1], model.at_rest(1)
            for k, row in enumerate(path[1:]):
                x, hidden = model.step(x, _weaving(x, {}), hidden)
                assert np.abs(model.difference(row[None], x)).max() < 1e-6, f"{p}, step {k}"


@pytest.mark.parametrize("name", VALUES)
def test_a_model_with_the_effect_can_be_verified(name):
    model = _model(name, VALUES[name][0])
    task = KeepOut({"steps": 20, "min_progress": 0.0}, model.nominal, DT)
    done = verify(
        _weaving,
        task,
        model,
        gap_set=GAP,
        laws=("uniform", "adversarial"),
        required=("uniform",),
        n=30,
        epsilon=0.2,
        beta=0.2,
        threshold=-10.0,
        seed=1,
        controller_digest="sha256:c",
        task_digest="sha256:t",
    )
    assert [law.n for law in done.laws] == [30, 30]
    assert np.isfinite([law.s_star for law in done.laws]).all()
