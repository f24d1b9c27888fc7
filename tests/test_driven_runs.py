"""Residuals of runs from a daemon's logs, and a composed statement from them, on the command line and on a certificate."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_rig import Rig

from s2r_runtime import messages as m
from s2r_runtime.api.composition import tubes_of
from s2r_runtime.api.models import weights_of
from s2r_runtime.errors import ConfigError, UsageError
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.driven_runs import DrivenRuns, read_driven_runs
from s2r_runtime.evidence.logged_deployments import Deployment, Run, without_radius
from s2r_runtime.evidence.trials import read_runs
from s2r_runtime.models.composed import compose
from s2r_runtime.profile import Profile, load_profile
from s2r_runtime.tasks.keep_out import KeepOut

RADIUS = 0.01
TASK = """name = "keep_out"
episodes = 8
[task.parameters]
steps = 10
min_progress = 0.0
start_clearance = 0.3
min_distance = 0.5
"""


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Eight scenarios of a controller that stands still, on a model without memory. Then its closed loop has the rate 1."""
    rig = Rig(tmp_path_factory.mktemp("driven"))
    text = rig.profile.read_text().replace('name = "grid_world"\n', TASK)
    effects, after = text.index("[[model.effects]]"), text.index("[region]")
    text = text[:effects] + text[after:]
    rig.profile.write_text(
        text.replace("hold_periods = 5\n", "hold_periods = 5\nn = 40\n").replace("[verification]", f"[verification]\nrun_radius = {RADIUS}")
    )
    try:
        rig.start_robot()
        rig.start()
        assert rig.sample()["exit_code"] == 0
        deployed = rig.ask("deploy", path=str(rig.controller("    return np.zeros((len(x), 2))\n")))
        assert deployed["exit_code"] == 0, deployed
        rig.until(lambda: rig.status()["scenarios"] >= 8)
        assert rig.stop() == 0
        yield rig
    finally:
        rig.close()


def found_in(rig: Rig, radius: float = RADIUS) -> DrivenRuns:
    profile = load_profile(rig.profile)
    model = compose(profile.model)
    norm = GapSet(profile.norm.set, weights_of(model.states, {}, profile), radius)
    return read_driven_runs(rig.log_files(), profile, KeepOut(profile.task.parameters, model.nominal, model.dt), model, norm)


def test_residuals_follow_from_the_observations_and_answers_in_the_log(driven: Rig) -> None:
    """The controller stands still, so a step's residual is by how much the observation moved."""
    found = found_in(driven)
    seen = {o.observation.seq: np.array(o.observation.x) for o in driven.messages("event/observed") if isinstance(o, m.Observed)}
    ended = [e for e in driven.messages("event/episode_ended") if isinstance(e, m.EpisodeEnded)]
    start = min(
        p.command.obs_seq for p in driven.messages("event/proposed") if isinstance(p, m.Proposed) and p.command.source == "controller"
    )
    weights = np.array([1.0, 1.0, 0.0525])
    expected = []
    for k in range(8):
        first = start + sum(e.steps for e in ended[:k])
        moved = [(seen[first + i + 1] - seen[first + i]) * weights for i in range(ended[k].steps)]
        expected.append(max(float(np.linalg.norm(one)) for one in moved))
    left = sum(found.left_out.values())
    assert left <= 1  # the first one may begin before the gate has opened
    assert [run.residual for run in found.runs] == pytest.approx(expected[left:])
    assert all(0.0 < run.residual < RADIUS for run in found.runs)
    with pytest.raises(ConfigError, match=r"verification\.run_radius was 0\.01 then, and 0.02 is meant; the radius is fixed before"):
        found_in(driven, 0.02)


@pytest.mark.slow
def test_the_command_line_composes_what_the_log_and_the_tubes_show(driven: Rig) -> None:
    logs, profile = [str(one) for one in driven.log_files()], ("--profile", "rig.toml")
    rate = ("--enclose", "--rate", "1", "--because", "it stands still")
    done = driven.s2r("trials", "controller.py", *logs, *profile, "--json", *rate)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    composition = found["composition"]
    assert composition["runs"]["outside"] == 0
    assert composition["runs"]["n"] == composition["runs"]["own"] >= 7
    assert composition["enclosure"]["rate_seen"] == pytest.approx(1.0)
    assert composition["upper"] == pytest.approx(min(1.0, composition["runs"]["upper"] + composition["enclosure"]["upper"]))
    assert "because it stands still" in found["statement"]
    bare = driven.s2r("trials", "controller.py", *logs, *profile, "--json", "--enclose")
    assert (bare.returncode, "State a rate of its closed loop: --rate L --because TEXT" in bare.stderr) == (2, True)
    low = driven.s2r("trials", "controller.py", *logs, *profile, "--enclose", "--rate", "0.9", "--because", "a guess")
    assert (low.returncode, "the stated rate 0.9 is refuted" in low.stderr, "worst found, not proved" in low.stderr) == (3, True, True)


def test_a_rate_is_stated_with_its_reason_and_for_an_enclosure() -> None:
    assert tubes_of(None, "", enclose=False) is None
    assert tubes_of(None, "", enclose=True) == (0.0, "")
    assert tubes_of(0.9, " derived ", enclose=True) == (0.9, "derived")
    for rate, because, enclose, words in (
        (1.0, "so", False, "--rate goes with --enclose"),
        (1.0, " ", True, "--rate L and --because TEXT go together"),
        (None, "so", True, "--rate L and --because TEXT go together"),
        (math.inf, "so", True, "--rate inf: must be above 0 and finite"),
    ):
        with pytest.raises(UsageError, match=words):
            tubes_of(rate, because, enclose=enclose)


@pytest.mark.slow
def test_a_controller_that_never_drove_is_certified_with_the_runs_of_another(driven: Rig) -> None:
    (log,) = map(str, driven.log_files())
    driven.controller("    return np.zeros((len(x), 2)) * 1.0\n", "new.py")
    rate = ("--enclose", "--rate", "1", "--because", "it stands still")
    trial = driven.s2r("trials", "new.py", log, "--profile", "rig.toml", *rate)
    assert (trial.returncode, "Composition (G13)." in trial.stdout) == (3, True), trial.stdout + trial.stderr
    assert driven.s2r("keys", "new", "own.pem").returncode == 0
    start = ("certify", "new.py", "--profile", "rig.toml", "--recording", log, "--key", "own.pem", "-o", "new.cert", "--json")
    done = driven.s2r(*start, *rate, "--runs", log)
    assert done.returncode == 0, done.stdout + done.stderr
    signed = json.loads((driven.folder / "new.cert").read_bytes())["certificate"]
    composition = signed["composition"]
    assert composition == json.loads(done.stdout)["composition"]
    assert (composition["runs"]["own"], composition["runs"]["controllers"]) == (0, 1)
    share = 3.0 * 0.1 / math.pi**2
    assert composition["runs"]["beta"] == composition["enclosure"]["beta"] == pytest.approx(share)
    assert any("whichever certified controller drives" in line for line in signed["shown"])
    for wrong, code, words in (
        (("--runs", log), 2, "--runs goes with --enclose"),
        (("--enclose", "--runs", log), 2, "State a rate"),
    ):
        refused = driven.s2r(*start, *wrong)
        assert (refused.returncode, words in refused.stderr) == (code, True), refused.stderr
    unset = driven.profile.read_text().replace(f"run_radius = {RADIUS}\n", "")
    (driven.folder / "unset.toml").write_text(unset)
    other = tuple("unset.toml" if one == "rig.toml" else one for one in start)
    refused = driven.s2r(*other, *rate)
    assert (refused.returncode, "verification.run_radius is 0; it fixes, before the runs" in refused.stderr) == (78, True)
    assert "no attempt was spent" in refused.stderr


def test_a_radius_fixed_later_leaves_the_logs_of_before_to_the_other_statements(driven: Rig) -> None:
    """Their profile had none. As trials they are read under the profile that has one; as runs against the radius they are refused."""
    text = driven.profile.read_text()
    later, none = (_written(driven.folder / f"{name}.toml", text.replace(f"run_radius = {RADIUS}", f"run_radius = {value}"))
                   for name, value in (("later", 0.5), ("none", 0.0)))  # fmt: skip
    profile, before = load_profile(later), load_profile(none)
    assert without_radius(profile).digest() == before.digest() != profile.digest()
    with pytest.raises(ConfigError, match="its profile is"):
        trials_in(driven, profile)  # of another radius than none


def trials_in(rig: Rig, profile: Profile) -> Any:
    model = compose(profile.model)
    return read_runs(rig.log_files(), profile, KeepOut(profile.task.parameters, model.nominal, model.dt), "sha256:c", "")


def _written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


# ---------------------------------------------------------------- which runs count


def deployment(*runs: Run) -> Any:
    found = Deployment("sha256:c", 1, "", None)  # type: ignore[arg-type]
    found.runs = list(runs)
    return found


def test_a_run_that_was_cut_counts_as_outside_and_one_that_began_closed_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    from s2r_runtime.evidence import driven_runs

    states = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]

    def run(index: int, **changes: Any) -> Run:
        given: dict[str, Any] = {"driven": True, "over": True, "states": states, "inputs": [(0.0, 0.0)], **changes}
        return Run(index, 2 * index, **given)

    given = deployment(
        run(0),
        run(1, over=False),
        run(2, closed=True),
        run(3, driven=False),
        run(4, driven=False, closed=True),
        run(5, driven=None),
        run(6, inputs=[None]),
        run(0),
    )
    given_logs: list[Any] = [[type("Log", (), {"head": b"h", "path": Path("x")})()]]
    monkeypatch.setattr(driven_runs, "in_order", lambda _paths: given_logs)
    monkeypatch.setattr(driven_runs, "_check_fixed", lambda _parts, _radius: None)
    monkeypatch.setattr(driven_runs, "deployments", lambda *_args, **_more: [given])
    model: Any = compose(load_profile(Path(__file__).parents[1] / "profiles" / "turtlebot-ros2-zenoh.toml").model)
    found = read_driven_runs([], None, None, model, GapSet("ball", (1.0, 1.0, 1.0), 0.1))  # type: ignore[arg-type]
    assert [one.residual for one in found.runs] == [0.0, math.inf, math.inf, math.inf, math.inf]
    assert found.left_out == {
        "not driven by the controller from its start": 2,
        "the same scenario as an earlier run (same seed)": 1,
    }
