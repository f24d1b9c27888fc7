"""Deployments of a comparison: given scenarios, which begin with the gate open; and a log that is read while it grows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_rig import Rig, answers, lockstep, of, one, sources
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.controllers.episodes import Episodes
from s2r_runtime.daemon.door import decode_request
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import (
    Ask,
    EpisodeCounted,
    EpisodeEnded,
    Observation,
    Observed,
    Scenarios,
    SourceStarted,
    SourceStopped,
    StartController,
)
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recording.followed import FollowedLog
from s2r_runtime.recording.reading import Reading
from s2r_runtime.recording.writer import Writer
from s2r_runtime.tasks.stl_task import StlTask

RUN = Scenarios(seed=99, first=4, count=1)


def certified(rig: Rig) -> None:
    """A controller with a certificate that does not drive."""
    rig.driving()
    rig.request("undeploy")
    rig.outputs.clear()


@pytest.mark.parametrize("rig", [lockstep(beta_episodes=0.1), Rig(beta_episodes=0.1)], ids=["lockstep", "realtime"])
def test_scenario_of_a_comparison_begins_with_the_gate_open_and_counts(rig: Rig) -> None:
    certified(rig)
    started = one(rig.request("deploy", digest="controller", scenarios=RUN), StartController)
    assert started.scenarios == RUN
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    for _ in range(20):
        outputs = rig.observe()
        if of(outputs, Ask):
            break
        assert set(sources(outputs)) <= {"recovery"}
    assert rig.state.gate_open
    for _ in range(3):
        assert sources(rig.propose()) == ["controller"]
        rig.observe()
    rig.feed(EpisodeEnded(rig.t, 4, 7, 0.5, 1.0))
    rig.feed(SourceStopped(rig.t, "controller", "finished", "all scenarios are over"))
    (counted,) = of(rig.outputs, EpisodeCounted)
    assert (counted.outcome, counted.index, counted.steps) == ("safe", 4, 7)
    assert rig.state.deployment is None
    assert not rig.state.gate_open


def test_comparison_verifies_nothing_and_takes_no_deployment_for_its_own() -> None:
    rig = Rig(beta_episodes=0.1)
    rig.gap()
    rig.request("deploy", digest="unknown", scenarios=RUN)
    (answer,) = answers(rig)[rig.requests]
    assert (answer.exit_code, "no certificate covers this controller" in answer.text) == (1, True)
    assert rig.state.deployment is None
    rig = Rig(beta_episodes=0.1)
    rig.driving()
    rig.request("deploy", digest="controller", scenarios=RUN)
    (answer,) = answers(rig)[rig.requests]
    assert (answer.exit_code, "another deployment" in answer.text) == (2, True)


def test_numbered_scenarios_are_those_of_a_deployment_from_the_start() -> None:
    model = compose(ModelSpec("unicycle", 0.1))
    scenario = {"post": [0.0, 1.0]}
    task = StlTask({"horizon": 0.3, "metric": "always (x < post + 9)", "progress": "none", "scenario": scenario}, model.nominal, 0.1)
    x, seen = np.zeros(3), dict[int, Any]()
    every = Episodes(task, 99)
    for _ in range(20):
        theta, now, _ = every.look(x)
        seen.setdefault(now.index, theta["post"] if theta else None)
    alone = Episodes.of(task, RUN)
    theta, now, _ = alone.look(x)
    assert (now.index, theta["post"]) == (4, seen[4])  # type: ignore[index]
    ends = [alone.look(x) for _ in range(3)]
    assert [(theta is None, now.done) for theta, now, _ in ends] == [(False, False), (False, False), (True, True)]


def test_request_names_scenarios_within_bounds() -> None:
    found = decode_request(b'{"verb":"deploy","path":"c.py","seed":99,"first":4,"count":1}').scenarios
    assert found == RUN
    assert decode_request(b'{"verb":"deploy","path":"c.py"}').scenarios is None
    for field, bad in (("seed", "9007199254740992"), ("first", "2147483648"), ("first", "0.5"), ("seed", "-1")):
        with pytest.raises(ConfigError, match=field):
            decode_request(f'{{"verb":"deploy","count":1,"{field}":{bad}}}'.encode())


def test_log_that_grows_over_several_parts_is_read_as_the_whole_one(tmp_path: Path) -> None:
    """At whatever byte a look finds the end, what was read in all is what the files hold in the end."""
    whole, growing = tmp_path / "whole", tmp_path / "growing"
    whole.mkdir()
    growing.mkdir()
    writer = Writer(whole / "a.mcap", run="test", signer=Ed25519PrivateKey.from_private_bytes(bytes(32)), rotate_bytes=2_000, timed=False)
    for k in range(600):
        writer.write(Observed(k, Observation(k, k, (0.1 * k, 0.2, 0.3))), k)
        if k % 15 == 14:
            writer.flush()
    writer.close()
    assert len(writer.parts) > 2
    expected = [entry.message for path in writer.parts for entry in Reading(path)]
    assert len(expected) == 600
    rng, found = np.random.default_rng(5), list[Any]()
    log: FollowedLog | None = None
    for path in writer.parts:
        data = path.read_bytes()
        for end in sorted({int(end) for end in rng.integers(1, len(data), 25)} | {len(data)}):
            (growing / path.name).write_bytes(data[:end])
            if log is None and end > 1000:
                log = FollowedLog(growing / path.name, ("event/observed",))
            found += [entry.message for part in log.parts() for entry in part] if log is not None else []
    assert log is not None
    assert found == expected
    assert [path.name for path in log.paths] == [path.name for path in writer.parts]


def test_damaged_byte_in_a_log_that_grows_ends_the_reading(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = Writer(path, run="test", timed=False)
    for k in range(100):
        writer.write(Observed(k, Observation(k, k, (0.1, 0.2, 0.3))), k)
        writer.flush()
    writer.close()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    log = FollowedLog(path, ("event/observed",))
    (part,) = log.parts()
    read = len(list(part))
    assert 0 < read < 100
    assert part.ending.kind == "broken"
    assert not list(part)
