"""Synthesis: what is searched, that the winner is verified on scenarios that had no part in choosing it, and that this is paid for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.controllers.candidates import Synthesis, declared_bounds, with_parameters
from s2r_runtime.controllers.file import ControllerFile, load
from s2r_runtime.controllers.hosted import batch_control
from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence.synthesize import BROKEN, search, search_seed
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.evidence.verify import seed_for
from s2r_runtime.models.composed import compose
from s2r_runtime.profile import load_profile
from s2r_runtime.tasks.stl_task import StlTask

PROFILE = """
[robot]
name = "brake"
[model]
name = "double_integrator"
dt = 0.1
[region]
x = [-2, 2]
y = [-1, 1]
vx = [-2, 2]
vy = [-2, 2]
[inputs]
ax = [-3, 3]
ay = [-3, 3]
[sampling]
hold_periods = 10
[guarantee]
epsilon = 0.05
[verification]
epsilon = 0.05
laws = ["uniform", "persistent"]
[task]
name = "stl"
[task.parameters]
horizon = 4.0
metric = "always (x < 1) and eventually (x > 0.5)"
start = { x = [-0.5, 0.0], vx = [0.0, 0.5] }
"""
CONTROLLER = '''"""Goes to `target`, softly or not."""
import numpy as np

PARAMETERS = {"target": 1.4, "gain": 1.0, "steps": 3, "name": "so"}  # what it starts from
BOUNDS = {"target": [0.2, 1.6], "gain": [0.2, 6.0]}


def control(x, theta, parameters):
    if parameters["gain"] > 5.9:
        raise ValueError("too much")
    pull = parameters["gain"] * (parameters["target"] - x[:, 0]) - 2.0 * np.sqrt(parameters["gain"]) * x[:, 2]
    return np.column_stack([np.clip(pull, -3, 3), -x[:, 1] - x[:, 3]])
'''


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    profile, controller = tmp_path / "brake.toml", tmp_path / "go.py"
    profile.write_text(PROFILE)
    controller.write_text(CONTROLLER)
    return profile, controller


def searched(files: tuple[Path, Path], evaluations: int = 40, number: int = 1, **bounds: tuple[float, float]) -> Synthesis:
    profile, file = load_profile(files[0]), load(files[1])
    model = compose(profile.model)
    task = StlTask(profile.task.parameters, model.nominal, model.dt)
    gap = GapSet("ball", (1.0,) * 4, 0.01, 0.03, 10)
    return search(
        file,
        declared_bounds(file, bounds),
        lambda one: batch_control(one, 2),
        task,
        model,
        gap_set=gap,
        laws=("uniform", "persistent"),
        threshold=0.0,
        n=40,
        evaluations=evaluations,
        seed=search_seed(file, gap, model, profile.task_digest(), number),
    )


def test_the_search_begins_with_the_files_own_values_and_finds_better_ones(files: tuple[Path, Path]) -> None:
    found = searched(files)
    assert len(found.tried) == 40
    assert found.tried[0].parameters == {"target": 1.4, "gain": 1.0}
    assert found.tried[0].failures["uniform"] > 0.5
    assert found.best.failures == {"uniform": 0.0, "persistent": 0.0}
    assert 0.5 < found.best.parameters["target"] < 1.0
    assert found.best.cost == min(c.cost for c in found.tried)
    for candidate in found.tried:
        assert 0.2 <= candidate.parameters["target"] <= 1.6
        assert 0.2 <= candidate.parameters["gain"] <= 6.0
        assert (candidate.cost == BROKEN) == (candidate.parameters["gain"] > 5.9) == ("too much" in candidate.trouble)


def test_a_seed_gives_one_search_and_another_seed_another(files: tuple[Path, Path]) -> None:
    assert searched(files, 12) == searched(files, 12)
    assert searched(files, 12) != searched(files, 12, number=2)


def test_whole_numbers_stay_whole(files: tuple[Path, Path]) -> None:
    found = searched(files, 10, steps=(1.0, 9.0))
    assert all(isinstance(c.parameters["steps"], int) for c in found.tried)


def test_what_was_searched_is_what_the_new_file_holds(files: tuple[Path, Path]) -> None:
    file = load(files[1])
    files[1].with_name("best.py").write_bytes(with_parameters(file, {"target": 0.75, "steps": 4}))
    again = load(files[1].with_name("best.py"))
    assert again.parameters == {"target": 0.75, "gain": 1.0, "steps": 4, "name": "so"}
    assert b"# what it starts from" in again.source
    assert again.source.split(b"BOUNDS")[1] == file.source.split(b"BOUNDS")[1]
    assert again.digest != file.digest


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("BOUNDS = ", "LIMITS = "), "declares no bounds to search within"),
        (('"target": [0.2, 1.6]', '"aim": [0.2, 1.6]'), "BOUNDS of 'aim', which is no number among its PARAMETERS"),
        (('"target": [0.2, 1.6]', '"name": [0.2, 1.6]'), "BOUNDS of 'name', which is no number"),
        (('"target": [0.2, 1.6]', '"target": [1.6, 0.2]'), "must be [low, high] with low < high"),
        (("[0.2, 1.6]", "[0.2, np.pi]"), "line 5: BOUNDS must be a literal"),
    ],
)
def test_bounds_that_make_no_sense_are_refused_on_one_line(files: tuple[Path, Path], change: tuple[str, str], told: str) -> None:
    files[1].write_text(CONTROLLER.replace(*change))
    with pytest.raises(ConfigError) as caught:
        declared_bounds(load(files[1]), {})
    assert told in str(caught.value)


def test_the_verification_has_another_seed_than_the_search(files: tuple[Path, Path]) -> None:
    found, file, profile = searched(files, 6), load(files[1]), load_profile(files[0])
    winner = ControllerFile(**{name: getattr(file, name) for name in file.__struct_fields__})
    seeds = {seed_for(winner.digest, compose(profile.model).spec.digest(), profile.task_digest(), attempt) for attempt in (1, 2, 3)}
    assert found.seed not in seeds
    draws = [np.random.default_rng([seed, 0]).random() for seed in seeds] + [np.random.default_rng([found.seed, 2, 0]).random()]
    assert len(set(draws)) == 4


def s2r(files: tuple[Path, Path], *arguments: str) -> Any:
    environment = {**os.environ, "XDG_CONFIG_HOME": str(files[0].parent / "config"), "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, "-m", "s2r_runtime.cli.main", *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        cwd=files[0].parent,
    )


@pytest.mark.slow
def test_the_verb_pays_for_the_winners_verification_and_tells_what_was_tried(files: tuple[Path, Path]) -> None:
    assert s2r(files, "keys", "new").returncode == 0
    few = ("--evaluations", "24", "--scenarios", "40")
    done = s2r(files, "synthesize", "go.py", "--profile", "brake.toml", "--radius", "0.01", "--hold-radius", "0.03", "-o", "best.py", *few)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "24 candidates tried, 40 scenarios for each law" in done.stdout
    assert "verified on fresh scenarios (attempt 1, beta 0.0152)" in done.stdout
    assert load(files[1].with_name("best.py")).parameters["name"] == "so"
    hopeless = ("--bound", "target=1.2:1.6", "--json")
    failed = s2r(files, "synthesize", "go.py", "--profile", "brake.toml", "--radius", "0.01", "-o", "none.py", *few, *hopeless)
    assert failed.returncode == 1, failed.stderr
    told = json.loads(failed.stdout)
    assert not told["passed"]
    assert told["attempt"] == 2
    assert told["beta_spent"] == pytest.approx(3 * 0.05 / np.pi**2 * 1.25)
    assert len(told["candidates"]) == told["evaluations"] == 24
    assert set(told["parameters"]) == {"target", "gain"}
    for wrong, words in (
        (("--bound", "target=a:b"), "must be NAME=LOW:HIGH"),
        (("--evaluations", "1"), "at least 2"),
        (("--bound", "nothing=0:1"), "no number among its PARAMETERS"),
    ):
        refused = s2r(files, "synthesize", "go.py", "--profile", "brake.toml", "--radius", "0.01", "-o", "x.py", *wrong)
        assert refused.returncode in {2, 78}
        assert words in refused.stderr
        assert not files[1].with_name("x.py").exists()
