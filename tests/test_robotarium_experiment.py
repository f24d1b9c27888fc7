"""The paper's experiment, in little: its literal r, what produces it, and everything that the tool draws and tells."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
import robotarium_experiment as experiment
from robotarium_truth import campaign, moved

from s2r_runtime.models.composed import wrap


@pytest.mark.parametrize(
    ("reading", "median", "low", "high"),
    [
        (experiment.Reading("random", False, "literal", True, "first"), 0.200, 0.193, 0.206),
        (experiment.Reading("random", True, "literal", True, "first"), 0.194, 0.182, 0.204),
        (experiment.Reading("stopped", False, "literal", True, "first"), 0.104, 0.102, 0.108),
    ],
)
def test_a_period_of_latency_makes_the_papers_literal_r_and_a_full_stop_half_of_it(
    reading: experiment.Reading, median: float, low: float, high: float
) -> None:
    """Bounds: of r over repeated experiments; of 60 of them a handful may lie outside of a 90 % interval."""
    rng = np.random.default_rng(1)
    radii = np.array([experiment.sampled(reading, experiment.FIRST, rng).max() for _ in range(60)])
    assert np.median(radii) == pytest.approx(median, abs=0.003)
    assert np.mean((radii < low) | (radii > high)) < 0.25


def test_headings_that_are_not_wrapped_are_wrong_by_a_turn() -> None:
    rng = np.random.default_rng(2)
    wrapped, raw = (experiment.sampled(experiment.Reading("random", True, "literal", w, "first"), 2400, rng).max() for w in (True, False))
    assert wrapped < 0.21
    assert raw == pytest.approx(2.0 * np.pi, abs=0.2)


def test_the_truth_moves_as_the_model_with_the_data_sheets_effects() -> None:
    rng = np.random.default_rng(3)
    x = np.column_stack([rng.uniform(-1.0, 1.0, (200, 2)), rng.uniform(-3.1, 3.1, 200)])
    u = rng.uniform([-0.2, -3.1], [0.2, 3.1], (200, 2))
    hidden, told, at = experiment.TRUTH.at_rest(200), x, x
    for period in range(5):
        told, hidden = experiment.TRUTH.step(told, u, hidden)
        at = moved(at, u if period else np.zeros_like(u))
    np.testing.assert_allclose(at[:, :2], told[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(at[:, 2] - told[:, 2]), 0.0, atol=1e-9)


def test_a_robot_that_arrives_is_at_a_waypoint_and_drives() -> None:
    taken = campaign(500, "arriving", np.random.default_rng(4), periods=1)
    assert np.all(np.abs(taken.path[0, :, 0]) < 1.6)
    assert np.median(np.hypot(*(taken.path[1] - taken.path[0])[:, :2].T)) > 0.001


def test_a_reading_is_five_words_in_order() -> None:
    assert experiment.reading_of("stopped,free,weighted,unwrapped,all") == experiment.Reading("stopped", False, "weighted", False, "all")
    for wrong in ("stopped", "free,stopped,weighted,wrapped,all", "stopped,free,weighted,wrapped,third"):
        with pytest.raises(argparse.ArgumentTypeError, match="must be one of each, in this order"):
            experiment.reading_of(wrong)


@pytest.mark.slow
def test_the_whole_experiment_runs_and_tells_what_came_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page, numbers = tmp_path / "page.html", tmp_path / "numbers.json"
    assert experiment.main(["--quick", "-o", str(page), "--json", str(numbers)]) == 0
    said = capsys.readouterr().out
    assert "the paper's .198 in the literal norm" in said
    found = json.loads(numbers.read_text())
    assert len(found["gaps"]) == len(experiment.READINGS)
    assert [(m["name"].split(",")[0], m["law"]) for m in found["models"]] == [
        (name, law) for name in ("paper's model", "data sheet's model") for law in ("uniform", "persistent")
    ]
    known = found["models"][2]
    assert known["winner"].startswith("grid")
    assert known["true_runs"]["n"] == 40
    assert [c["n"] for c in known["final"]["claims"]] == [300, 500]
    html = page.read_text()
    assert html.count("<svg") >= 8
    assert "src=" not in html
    assert "http" not in html.replace("http://www.w3.org", "")
