"""The recordings of `examples/` are what their makers write, and hold what they say that they hold."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.pipeline import load_dataset, trace

MOTOR = Path(__file__).parent.parent / "examples" / "motor"
FRICTION_RAD_PER_S2, DELAY_S = 0.02 / 4e-4, 0.06


def test_the_motors_recordings_are_what_its_maker_writes(tmp_path):
    subprocess.run([sys.executable, str(MOTOR / "record.py"), str(tmp_path)], check=True, timeout=60)
    for name in ("drive.csv", "another.csv"):
        kept, made = (np.loadtxt(folder / name, delimiter=",", skiprows=1) for folder in (MOTOR, tmp_path))
        np.testing.assert_allclose(made, kept, atol=0.0011)  # the last digit may be rounded otherwise by another machine


def test_its_maker_says_in_a_line_what_it_needs(tmp_path):
    for more in ([], [str(tmp_path / "none")]):
        done = subprocess.run([sys.executable, str(MOTOR / "record.py"), *more], capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
        assert "python record.py FOLDER" in done.stderr


def test_the_page_shows_the_model_that_is_there():
    page = (MOTOR.parent.parent / "docs" / "first-trace.md").read_text(encoding="utf-8")
    source = (MOTOR / "motor.py").read_text(encoding="utf-8")
    assert source.split('"""', 2)[2].strip() in page


@pytest.mark.slow
def test_what_the_motors_data_sheet_does_not_tell_is_found():
    model = compose(ModelSpec(str(MOTOR / "motor.py"), 0.02))
    result = trace(load_dataset(MOTOR / "drive.csv", model), model)
    delay, friction = sorted(result.effects, key=lambda e: e.name, reverse=True)
    assert (delay.name, delay.channel, friction.name, friction.channel) == ("input_delay", "volts", "coulomb_friction", "speed")
    for found, number, true in ((delay, "delay", DELAY_S), (friction, "force", FRICTION_RAD_PER_S2)):
        _, low, high, _ = found.parameters[number]
        assert low < true < high
