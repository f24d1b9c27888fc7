"""Models in a robot's state folder: found by their digest, or refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2r_runtime.daemon.model_store import ModelStore
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Memory
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.profile import Profile, parse_profile


def test_a_model_is_kept_by_its_digest_and_never_forgets_what_it_was_fitted_on(tmp_path: Path) -> None:
    base = ModelSpec("unicycle", 0.1)
    store = ModelStore(tmp_path, base.digest())
    repaired = ModelSpec("unicycle", 0.1, effects=(EffectSpec("input_gain", "v", {"gain": 0.7}),), fitted_on=("sha256:a",))
    store.keep(repaired)
    assert store.keep(ModelSpec("unicycle", 0.1, effects=repaired.effects, fitted_on=("sha256:b",))).fitted_on == ("sha256:a", "sha256:b")
    assert store.load(repaired.digest()) == ModelSpec("unicycle", 0.1, effects=repaired.effects, fitted_on=("sha256:a", "sha256:b"))
    assert store.load(base.digest()) is None
    assert ModelStore(tmp_path, "another profile's").load(repaired.digest()) is None
    store.file(repaired.digest()).write_text(store.file(repaired.digest()).read_text().replace("0.7", "0.8"))
    with pytest.raises(ConfigError, match="is not the model that was adopted"):
        store.load(repaired.digest())
    store.file(repaired.digest()).write_text("no")
    with pytest.raises(ConfigError, match="is damaged"):
        store.load(repaired.digest())


def test_the_adopted_model_is_in_force_and_a_changed_profile_has_the_last_word(tmp_path: Path) -> None:
    profile = robot()
    repaired = ModelSpec("unicycle", 0.033, effects=(EffectSpec("input_gain", "v", {"gain": 0.7}),))
    store = ModelStore(tmp_path, profile.model.digest())
    adopted = Memory("rig", 1, model_digest=repaired.digest())
    assert store.in_force(profile, adopted).model == profile.model, "its file is not there"
    store.keep(repaired)
    assert store.in_force(profile, adopted).model == repaired
    assert store.in_force(profile, Memory("rig", 1)).model == profile.model
    assert store.in_force(profile, Memory("rig", 1, model_digest=profile.model.digest())).model == profile.model
    store.file(repaired.digest()).rename(tmp_path / "model.toml")  # as version 0.1 kept it
    assert store.in_force(profile, adopted).model == repaired
    changed = ModelStore(tmp_path, "sha256:" + "0" * 64)
    assert changed.in_force(profile, adopted).model == profile.model


def robot() -> Profile:
    from daemon_rig import PROFILE

    return parse_profile(PROFILE.format(clock="lockstep", more=""), "rig.toml", Path())
