"""Other quadrupeds behind the built-in one's profile: whatever their habits, a campaign ends, with its samples or with a plain answer."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from other_walker import OtherWalker
from quadruped_truth import campaign_of

from s2r_runtime.daemon import campaign_run
from s2r_runtime.messages import Observation
from s2r_runtime.profile import Profile, load_profile

ROOT = Path(__file__).parent.parent
SECOND, TENTH = (load_profile(ROOT / "profiles" / f"{name}.toml") for name in ("quadruped-second", "quadruped"))
PROFILES = pytest.mark.parametrize("profile", [SECOND, TENTH], ids=["second", "tenth"])
GIVES_UP_S = 1500.0
"""Robot's seconds within which a campaign with a robot that lies ends: five waypoints, two minutes each, and what came before."""


def sampled(profile: Profile, n: int = 6, most_s: float = GIVES_UP_S, **habits: float) -> tuple[Any, Any, float]:
    """(last step, progress, robot's seconds) of a campaign on this robot in this process."""
    robot = OtherWalker(dt=profile.model.dt, **habits)
    campaign, k = campaign_of(profile, n, 1), 0
    while robot.now_s < most_s:
        step = campaign.step(Observation(k, round(1e9 * robot.now_s), robot.tells()))
        if step.done or step.failed:
            break
        robot.walk(step.u[0], step.u[1], robot.period())
        k += 1
    return step, campaign.progress(), robot.now_s


@PROFILES
@pytest.mark.parametrize(
    "habits",
    [
        {"jitter": 0.001},
        {"turns": 1.0},
        {"lag": 0.3},
        {"marches": 0.03},
        {"numb": 0.08},
    ],
    ids=["its stamps jitter", "its yaw counts turns", "it lags by .3 s", "it creeps while it stands", "small commands are none"],
)
def test_it_is_sampled_whatever_its_habits(profile: Profile, habits: dict[str, float]) -> None:
    step, progress, _ = sampled(profile, **habits)
    assert step.done
    assert progress.taken == 6
    assert progress.rejected.keys() <= ({"off_step"} if "jitter" in habits else set())  # holds whose end was no whole step away


@PROFILES
@pytest.mark.parametrize(
    ("how", "says"),
    [(0.0, "toward 5 waypoints, the robot did not move from"), (3.0, "5 waypoints in a row were not reached")],
    ids=["still", "turning"],
)
def test_one_that_fell_and_says_nothing_of_it_ends_the_campaign_in_minutes(profile: Profile, how: float, says: str) -> None:
    step, progress, now_s = sampled(profile, n=1000, falls=60.0, how=how)
    assert says in step.failed
    assert step.u == (0.0, 0.0)
    assert progress.taken < 10
    assert now_s < GIVES_UP_S


def test_a_campaign_whose_robot_went_away_is_kept_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    now, ended = [1000.0], []
    monkeypatch.setattr(campaign_run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    script = campaign_run._Script(0, 60.0, None, None, "")
    daemon: Any = SimpleNamespace(
        state=SimpleNamespace(link_up=True, observation=object()),
        desk=SimpleNamespace(request=lambda *_, **__: 7, answers={}),
        sampler=SimpleNamespace(samples=[1, 2], n=9, progress=lambda: None),
        end=ended.append,
    )
    script(daemon)
    for link_up, later in ((True, 300.0), (False, 50.0), (True, 1.0), (False, 50.0)):
        daemon.state.link_up = link_up
        now[0] += later
        script(daemon)
    assert not ended, "it was never away for a minute"
    now[0] += 20.0
    script(daemon)
    assert (script.exit_code, ended) == (3, [script.text])
    assert script.text == "the robot was not heard for 60 s, after 2 of 9 samples; the same command goes on with it"


# ---------------------------------------------------------------- over real Zenoh


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("how", "code", "says"),
    [
        (1.0, 3, "the gate refuses the sampler (observation_invalid)"),
        (2.0, 0, "gap of epoch 1"),
    ],
    ids=["tells NaN once it fell", "begins anew without a boot number"],
)
def test_a_fall_over_the_link_ends_with_an_answer(tmp_path: Path, how: float, code: int, says: str) -> None:
    with ExitStack() as stack:
        ports = [stack.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(2)]
    text = (ROOT / "profiles" / "quadruped-second.toml").read_text(encoding="utf-8")
    changed = {"epsilon = 0.05": "epsilon = 0.5", "7461": str(ports[0]), "7462": str(ports[1])}
    for old, new in {**changed, "observation_timeout = 5.0": "observation_timeout = 2.0"}.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    profile = tmp_path / "quadruped.toml"
    profile.write_text(text, encoding="utf-8")
    (tmp_path / "run").mkdir(mode=0o700)
    robot = [sys.executable, str(Path(__file__).parent / "rigs" / "other_walker.py"), f"tcp/127.0.0.1:{ports[0]}", "falls=30", f"how={how}"]
    sample = [sys.executable, "-m", "s2r_runtime.cli.main", "sample", str(profile), "-o", str(tmp_path / "walk.mcap"), "--json"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path / "run"), "XDG_STATE_HOME": str(tmp_path / "state")}
    walking = subprocess.Popen(robot, stdin=subprocess.DEVNULL)
    try:
        done = subprocess.run(sample, capture_output=True, text=True, timeout=240, check=False, env=environment)
    finally:
        walking.terminate()
        walking.wait(30)
    answer = json.loads(done.stdout)
    assert done.returncode == code, done.stdout + done.stderr
    assert says in answer["text"]
    if code == 0:
        assert math.isfinite(answer["gap"]["radius"])
