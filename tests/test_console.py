"""What a daemon says to whoever reads its console: one line an event, in plain words; and what a refused campaign leaves."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime import gate
from s2r_runtime import messages as m
from s2r_runtime.core.reasons import WORDS, in_words
from s2r_runtime.core.state import State
from s2r_runtime.daemon.console import REPEAT_NS, Console


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    yield opened
    opened.close()


BUSY = ("log ", "this computer: ", "the robot is ", "gate closed: the robot is not heard", "gate closed: no controller is deployed")
"""Where a log is; and what a busy machine adds: a robot that gets no processor for a second is not heard."""


def lines(rig: Rig) -> list[str]:
    """What the daemon said since its log began, without digests."""
    said = [line.removeprefix("s2r: ") for line in rig.said().splitlines()]
    begin = next(number for number, line in enumerate(said) if line.startswith("robot 'rig': log "))
    return [re.sub(r"sha256:[0-9a-f]{64}", "ID", line) for line in said[begin + 1 :]]


def test_every_reason_of_the_gate_has_plain_words() -> None:
    assert set(WORDS) == {*gate.REASONS, gate.ALLOWED}
    assert in_words("latched:link_down") == "the robot is not heard (link_down), until: s2r clear link_down"


@pytest.mark.slow
def test_a_short_story_on_the_console_line_by_line(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until_status(link=True)
    rig.until(lambda: rig.status()["observation"])
    user = rig.ask("sample")["text"]
    assert "no_permit" in user
    rig.ask("permit", duration_s=3600.0)
    assert rig.ask("sample", count=12)["exit_code"] == 0
    controller = rig.controller()
    radius = rig.status()["gap_radius"]
    assert rig.ask("deploy", path=str(controller), certificate=rig.certificate(controller, epoch=2))["exit_code"] == 0
    rig.until_status(gate="open")
    rig.ask("stop")
    assert rig.stop() == 0
    gap = f"{radius:.6g}"
    by = f"user {os.getuid()}"
    said = lines(rig)
    told = [line for line in said[said.index(f"{by}: s2r sample") :] if not line.startswith(BUSY)]
    expected = [
        f"{by}: s2r sample",
        "refused: no_permit: give one: s2r permit DURATION",
        f"{by}: s2r permit 3600",
        "the sampler may drive for 3600 s",
        f"{by}: s2r sample -n 12",
        "campaign of epoch 1 begins: 12 samples; it spends 0.15 of beta 0.5, 0.348 is left",
        "sample 10 of 12",
        "sample 12 of 12",
        "12 samples taken; computing the gap",
        f"gap of epoch 1: {gap} at epsilon 0.3, from 12 samples",
        "certificate ID: verified to radius 0.02",
        "certificate ID loaded",
        f"{by}: s2r deploy {controller}",
        "deployed under certificate ID",
        "gate open: the controller drives",
        f"{by}: s2r stop",
        "gate closed: emergency stop (emergency_stop): by " + by,
        "stopped; nothing drives until: s2r clear emergency_stop",
        "gate closed: the daemon is ending (stopping): SIGTERM",
    ]
    assert told == expected, "\n".join(told)
    assert not re.search(r"head [0-9a-f]{64}", "\n".join(told)), "heads are for the log"


def test_what_repeats_is_counted_and_an_alarm_is_never_held_back() -> None:
    said: list[str] = []
    console, state = Console(said.append), State()
    for number in range(100):
        console.decided([m.GateChanged(number * 10**8, open=False, reason="link_down")], state)
    assert said == ["gate closed: the robot is not heard (link_down)"]
    console.decided([m.GateChanged(REPEAT_NS, open=False, reason="link_down")], state)
    assert said[1:] == ["gate closed: the robot is not heard (link_down) (99 more times since)"]
    for _ in range(2):
        console.decided([m.AlarmRaised(REPEAT_NS, 120.0, 0.01, 3)], state)
    alarm = "ALARM: the watch refuted the gap of epoch 3 (e-value 120); a fresh campaign is due: s2r sample"
    assert said[2:] == [alarm, alarm]


@pytest.mark.slow
def test_a_refused_campaign_is_repeated_traced_reported_and_audited(tmp_path: Path) -> None:
    """A robot that changes slowly: both campaigns are refused, and their data are there, also after a restart."""
    rig = Rig(tmp_path, more="[repair]\nrows = 600\n")
    try:
        _refused_story(rig)
    finally:
        rig.close()


def _refused_story(rig: Rig) -> None:
    rig.start_robot("--sway", "0.6")
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    done = rig.s2r("sample", str(rig.profile), "-n", "60", "--retry")
    assert done.returncode == 3, done.stdout
    assert "campaign of epoch 1 begins: 60 samples; it spends" in done.stderr
    assert "it is repeated now (epoch 2 takes 12 samples and spends" in done.stderr
    assert "campaign of epoch 2 begins: 60 samples; it spends" in done.stderr
    assert "2 in a row are hardly chance: the robot drifts" in done.stderr
    found: dict[str, Any] = rig.status()
    assert (found["refused_campaign"]["epoch"], found["refused_campaign"]["in_a_row"], found["epoch"]) == (2, 2, 2)
    shown = rig.s2r("status", "--socket", str(rig.socket)).stdout
    assert "It never runs out: number i spends 3 beta/(pi^2 i^2)" in shown
    assert f"campaign 3 ({found['next_campaign']['beta']:.2g}, {found['next_campaign']['n']} samples)" in shown
    assert rig.stop() == 0
    rig.start()
    answer = rig.ask("trace", text="campaign")
    assert (answer["exit_code"], answer["text"].startswith("trace of the refused campaign of epoch 2: ")) == (0, True), answer
    assert rig.stop() == 0
    logs = list(map(str, rig.log_files()))
    audited = json.loads(rig.s2r("audit", *logs, "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert (audited["ok"], audited["first_difference"]) == (True, None), audited
    assert audited["recomputed"]["traces checked against their rows"] == 1
    page = rig.folder / "report.html"
    assert rig.s2r("report", logs[0], "-o", str(page)).returncode == 0
    html = page.read_text()
    assert "Refused campaign of epoch 1" in html
    assert "discrepancies in the order in which they were sampled" in html
