"""The rover's profile, controller and experiment as far as they need no simulator."""

from __future__ import annotations

import difflib
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("s2r_mavlink")

import rover_experiment as experiment
import rover_figures as figures
from rover_sitl import find_folder, profile_text
from rover_story import CONTROLLER, PROFILE, Told

from s2r_runtime.errors import ConfigError


def test_absent_simulator_is_one_line_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("S2R_SITL", str(tmp_path / "nowhere"))
    assert experiment.main([]) == ConfigError.exit_code
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert "nowhere" in said[0]
    assert "--sitl FOLDER or S2R_SITL=FOLDER" in said[0]


def test_named_folder_comes_before_the_setting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ardurover", "rover-skid.parm"):
        (tmp_path / name).touch()
    monkeypatch.setenv("S2R_SITL", str(tmp_path / "nowhere"))
    assert find_folder(tmp_path) == tmp_path


def test_story_uses_the_shipped_profile_with_two_lines_changed() -> None:
    shipped = PROFILE.read_text(encoding="utf-8")
    used = profile_text(PROFILE, "rover7", "tcp:127.0.0.1:5960")
    changed = [line for line in difflib.ndiff(shipped.splitlines(), used.splitlines()) if line[:2] in ("- ", "+ ")]
    assert changed == [
        '- name = "rover"',
        '+ name = "rover7"',
        '- robot = "udp:127.0.0.1:14551"',
        '+ robot = "tcp:127.0.0.1:5960"',
    ]


def test_page_and_lines_of_a_story_that_ended_early_say_so(tmp_path: Path) -> None:
    told = Told("rover1", tmp_path, error="no certificate: the controller was refused")
    told.steps.append({"verb": "sample rover.toml", "at_s": 1.0, "seconds": 2.0, "exit_code": 1, "text": "stopped\n"})
    lines = experiment.outcome_lines([told], {})
    assert lines[0].startswith("rover1: not complete")
    assert "no certificate: the controller was refused" in lines[-1]
    page = figures.page([told], {}, lines)
    assert "0 of 1 stories were complete" in page
    assert "s2r sample rover.toml" in page


@pytest.mark.slow
def test_shipped_controller_passes_at_three_times_the_gap_of_a_real_campaign() -> None:
    """0.0076 m in one step, 0.118 m over a hold: a campaign on ArduPilot's simulator."""
    options = ["--profile", str(PROFILE), "--radius", str(3 * 0.0076), "--hold-radius", str(3 * 0.118)]
    done = subprocess.run(
        [sys.executable, "-m", "s2r_runtime", "verify", str(CONTROLLER), *options], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
