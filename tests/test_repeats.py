"""Copies count once, and rows that chance does not make so alike carry no statement (guarantee G1)."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.gap import blocked, doubted, estimate_gap
from s2r_runtime.evidence.repeats import ALPHA, repeats
from s2r_runtime.messages import REPEATED
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recordings.transitions import Transitions

MODEL = compose(ModelSpec("unicycle", 0.1))
SETTINGS = {"epsilon": 0.01, "beta": 0.05, "weights": (1.0, 1.0, 1.0)}
SURE = 1e-3


def drawn(rng: np.random.Generator, n: int, noise: float = 2e-3) -> Transitions:
    x0, u = rng.uniform((-1, -1, -3), (1, 1, 3), (n, 3)), rng.uniform((-0.2, -2), (0.2, 2), (n, 2))
    return ended(rng, x0, u, noise)


def ended(rng: np.random.Generator, x0: np.ndarray, u: np.ndarray, noise: float = 2e-3) -> Transitions:
    x1, _ = MODEL.step(x0, u, MODEL.at_rest(len(x0)))
    return Transitions(x0, u, x1 + noise * rng.normal(size=x0.shape), None, 1, True, {}, "sha256:0", 3.0 * np.arange(len(x0)), "test")


def joined(*parts: Transitions, noise: float = 0.0) -> Transitions:
    """All rows; those of the later parts shaken."""
    rng = np.random.default_rng(9)
    rows = {
        name: np.concatenate(
            [getattr(p, name) + (noise * rng.normal(size=getattr(p, name).shape) if k else 0.0) for k, p in enumerate(parts)]
        )
        for name in ("x0", "u", "x1")
    }
    return replace(parts[0], **rows, t0_s=np.concatenate([p.t0_s for p in parts]))


def refused(tr: Transitions) -> bool:
    gap = estimate_gap(MODEL, tr, **SETTINGS)
    return doubted(gap, tr) is not tr and gap.white_reason.startswith(REPEATED)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-9, 1e-7, 1e-5])
def test_a_table_joined_to_itself_in_another_order_carries_no_statement(noise: float) -> None:
    rng = np.random.default_rng(1)
    tr = drawn(rng, 160)
    double = joined(tr, tr.chosen(rng.permutation(160)), noise=noise)
    assert refused(double)
    assert estimate_gap(MODEL, double, **SETTINGS).n == 160 or noise >= 1e-9


def test_one_copied_row_is_not_by_chance_and_counts_once() -> None:
    tr = drawn(np.random.default_rng(2), 320)
    found = repeats(*(np.concatenate([a, a[:1]]) for a in (tr.x0, tr.u, tr.x1)), MODEL.angle_columns)
    assert found.distinct == 320
    assert found.doubt.startswith(REPEATED)


def test_mixtures_of_rows_are_no_draws() -> None:
    rng = np.random.default_rng(3)
    tr = drawn(rng, 100)
    share, (a, b) = rng.uniform(size=(200, 1)), rng.integers(100, size=(2, 200))
    mixed = replace(tr.chosen(a), **{k: share * getattr(tr, k)[a] + (1 - share) * getattr(tr, k)[b] for k in ("x0", "u", "x1")})
    assert refused(joined(tr, mixed))


@pytest.mark.slow
def test_independent_draws_of_coarse_laws_are_refused_no_more_often_than_said() -> None:
    """A quantised sensor, few inputs, few places, inputs that follow the state, one dimension only."""
    rng, count = np.random.default_rng(4), 60
    places = rng.uniform((-1, -1, -3), (1, 1, 3), (12, 3))
    found = 0
    for _ in range(count):
        tr = drawn(rng, 300)
        coarse = replace(tr, x0=np.round(tr.x0, 2), x1=np.round(tr.x1, 2))
        stations = ended(rng, places[rng.integers(12, size=300)], np.round(tr.u, 1), 0.0)
        law = ended(rng, tr.x0, np.column_stack([-0.1 * tr.x0[:, 0], np.sin(tr.x0[:, 2])]), 0.0)
        line = ended(rng, tr.x0 * [1.0, 0.0, 0.0], tr.u * 0.0)
        found += sum(bool(repeats(t.x0, t.u, t.x1, MODEL.angle_columns).doubt) for t in (tr, coarse, stations, law, line))
    assert clopper_pearson_lower(found, 5 * count, SURE) <= 2.0 * ALPHA


def test_a_robot_that_often_begins_at_home_and_at_rest_draws_all_the_same() -> None:
    """A law with an atom: rows that are there and elsewhere make many lines that are nearly one."""
    rng, n = np.random.default_rng(7), 300
    for _ in range(10):
        x0 = np.where(rng.random((n, 1)) < 0.3, 0.0, rng.uniform(-1.0, 1.0, (n, 3)))
        u = np.where(rng.random((n, 1)) < 0.3, 0.0, rng.uniform(-1.0, 1.0, (n, 2)))
        found = repeats(x0, u, x0 + 0.05 * u[:, [0, 1, 1]] + 1e-4 * rng.normal(size=(n, 3)))
        assert found == (n, "")


def test_equal_draws_of_a_law_of_few_values_count_once() -> None:
    rng = np.random.default_rng(5)
    stations = ended(rng, np.round(rng.uniform(-1, 1, (400, 3)), 0), np.round(rng.uniform(-1, 1, (400, 2)), 0), 0.0)
    with pytest.raises(NotEnoughEvidence, match=r"copies") as told:
        estimate_gap(MODEL, stations, **SETTINGS)
    assert "of 400" not in str(told.value)


def test_the_discarded_are_discarded_with_their_copies_in_place() -> None:
    """A row that is the largest and there twice: discarding one leaves its copy, whether they are copies or equal draws."""
    rng = np.random.default_rng(6)
    tr = replace(drawn(rng, 600), assumption="vouched for")
    tr.x1[0] += 1.0
    double = joined(tr, tr.chosen(np.array([0])))
    alone, with_copy = (estimate_gap(MODEL, t, epsilon=0.01, beta=0.05, discard=1, weights=(1.0, 1.0, 1.0)) for t in (tr, double))
    assert with_copy.n == alone.n == 600
    assert with_copy.radius > 1.0 > alone.radius


def test_a_robot_that_stands_still_repeats_itself_and_counts_once(tmp_path: Path) -> None:
    rows = [f"{0.1 * k!r},{0.001 * (k % 700 if k < 700 else 700)!r},0,0,{0.01 if k < 700 else 0},0" for k in range(1400)]
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(["t,x,y,theta,v,w", *rows]))
    from s2r_runtime.recordings.loading import load_transitions

    tr = blocked(load_transitions(path, MODEL), 0.3, 0.1)
    gap = estimate_gap(MODEL, tr, epsilon=0.05, beta=0.05, weights=(1.0, 1.0, 1.0))
    assert gap.rejected["copies"] > 200
    assert doubted(gap, tr, (REPEATED,)) is tr


@pytest.mark.slow
def test_the_command_line_refuses_a_table_of_copies_and_says_how_many_rows_differ(tmp_path: Path) -> None:
    tr = drawn(np.random.default_rng(7), 20)
    lines = ["segment,t,x,y,theta,v,w"]
    for s in range(300):
        x0, u, x1 = (", ".join(map(repr, part[s % 20].tolist())) for part in (tr.x0, tr.u, tr.x1))
        lines += [f"{s},0,{x0},{u}", f"{s},0.1,{x1},,"]
    path = tmp_path / "table.csv"
    path.write_text("\n".join(lines) + "\n")
    argv = [sys.executable, "-m", "s2r_runtime", "gap", str(path), "--model", "unicycle", "--dt", "0.1", "--json"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 3, done.stderr
    answer = json.loads(done.stdout)
    assert (answer["n"], answer["rejected"], answer["independent"]) == (20, {"copies": 280}, False)
    assert "280 of 300 are copies" in answer["statement"]
