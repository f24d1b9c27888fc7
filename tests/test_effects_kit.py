"""Every built-in effect on inputs passes the kit that authors of effects get, at several sets of values."""

import numpy as np
import pytest
from effects_rig import ON_JOINTS, ON_STEERING, VALUES

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.testing import EffectKit

for _name, (_first, *_others) in {**VALUES, **ON_STEERING, **ON_JOINTS}.items():
    _class = f"Test_{_name}"
    globals()[_class] = type(
        _class, (EffectKit,), {"effect": registry().get("effects", _name), "parameters": _first, "others": tuple(_others)}
    )


def test_no_effect_on_inputs_is_left_out():
    offered = {name for name in registry().names("effects") if registry().get("effects", name).stage == "input"}
    assert offered == {*VALUES, *ON_STEERING, *ON_JOINTS}


class _Wrong:
    """An input gain that claims what is not so."""

    def __init__(self, name, **claims):
        given = registry().get("effects", name)
        for attribute in dir(given):
            if not attribute.startswith("__"):
                setattr(self, attribute, getattr(given, attribute))
        for claim, value in claims.items():
            setattr(self, claim, value)


@pytest.mark.parametrize(
    ("effect", "p", "test", "says"),
    [
        (_Wrong("input_saturation", linear=True), {"high": 0.5}, "test_what_it_claims_of_itself_is_true", "not linear"),
        (_Wrong("input_gain_drift", linear=True), {"rate": 0.2}, "test_what_it_claims_of_itself_is_true", "not linear"),
        (_Wrong("input_lag", shift=True), {"time_constant": 0.1}, "test_what_it_claims_of_itself_is_true", "not a shift"),
        (
            _Wrong("input_delay", shift=False, linear=False, additive=True),
            {"delay": 0.1},
            "test_what_it_claims_of_itself_is_true",
            "not the sum",
        ),
        (
            _Wrong("input_rate_limit", within_step=lambda dt, p: False),
            {"rate": 2.0},
            "test_a_step_is_the_mean_of_its_parts",
            "nothing changes",
        ),
        (
            _Wrong("input_coupling", reads=lambda model, channel: ()),
            {"from": "", "coefficient": 0.3},
            "test_only_the_channel_changes_and_only_by_what_it_reads",
            "assert",
        ),
        (
            _Wrong("input_gain_drift", input_step=registry().get("effects", "input_gain").input_step),
            {"rate": 0.2, "gain": 1.0},
            "test_a_run_that_begins_later_knows_its_time",
            "Not equal",
        ),
    ],
)
def test_a_claim_that_is_not_true_fails(effect, p, test, says):
    kit = EffectKit()
    kit.effect, kit.parameters = effect, p
    with pytest.raises(AssertionError, match=says):
        getattr(kit, test)([(registry().get("models", "unicycle"), "w")])


@pytest.mark.parametrize("name", [name for name in VALUES if name != "wheel_saturation"])
def test_a_user_s_own_model_gets_every_effect_on_its_inputs(name, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("STATES, INPUTS, PARAMS = ('a', 'b'), ('p', 'q'), {}\ndef step(x, u, dt, params):\n    return x + dt * u\n")
    for given in VALUES[name]:
        p = {**given, "from": "q"} if "from" in given else given
        model = compose(ModelSpec(str(path), 0.1, {}, (EffectSpec(name, "p", p),)))
        x, hidden = np.zeros((2, 2)), model.at_rest(2)
        u = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 2))
        for row in u:
            x, hidden = model.step(x, np.tile(row, (2, 1)), hidden)
        acting = model.effects[0].effect.input_sequence(u, model.nominal, "p", 0.1, p)
        assert x == pytest.approx(np.tile(0.1 * acting.sum(axis=0), (2, 1)))
        assert model.effects[0].effect.unit(model.nominal, "p", next(iter(p))) is not None
