"""A model's gap is refused on rows that its fit saw, whatever was done to the table, and not on a fresh recording (guarantee G6)."""

from __future__ import annotations

import base64
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.gap import refuse_fitted
from s2r_runtime.evidence.seen_rows import ALPHA, FALSE_BITS, KEPT, TEXT_MAX, seen, sketch, united
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import COMPACT, PREFIX, ModelSpec, dump_model, form_of, load_model
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.trace.data.readers import load_dataset

DT = 0.1
MODEL = compose(ModelSpec("unicycle", DT))
Rows = list[list[str]]
SURE = 1e-3


def table(path: Path, seed: int, segments: int = 120, fast: int = 5) -> Path:
    """Held inputs of 1 s, rows `fast` times a step of the model."""
    rng, lines = np.random.default_rng(seed), ["segment,t,x,y,theta,v,w"]
    for s in range(segments):
        x, u = rng.uniform((-1, -1, -3), (1, 1, 3)), rng.uniform((-0.2, -2), (0.2, 2))
        for k in range(10 * fast):
            seen_x = x + 1e-4 * rng.normal(size=3)
            lines.append(f"{s},{k * DT / fast:.3f},{','.join(map(repr, seen_x.tolist()))},{float(u[0])!r},{float(u[1])!r}")
            x = x + DT / fast * np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[1]])
    path.write_text("\n".join(lines) + "\n")
    return path


def by_segment(rows: Rows) -> list[Rows]:
    found: dict[str, Rows] = {}
    for row in rows:
        found.setdefault(row[0], []).append(row)
    return list(found.values())


def moved_in_time(rows: Rows) -> Rows:
    return [[s, f"{float(t) + 1000.0:.3f}", *rest] for s, t, *rest in rows]


def reordered(rows: Rows) -> Rows:
    return [row for part in reversed(by_segment(rows)) for row in part]


def one_row_less(rows: Rows) -> Rows:
    return [row for part in by_segment(rows) for row in part[1:]]


def off_the_grid(rows: Rows) -> Rows:
    return [row for part in by_segment(rows) for row in part[3:]]


def first_transition_only(rows: Rows) -> Rows:
    return [row for part in by_segment(rows) for row in (part[0], part[5])]


def one_segment(rows: Rows) -> Rows:
    return rows[:50]


def rounded(rows: Rows) -> Rows:
    return [[s, t, *(f"{float(v):.7f}" for v in rest)] for s, t, *rest in rows]


def shaken(rows: Rows) -> Rows:
    return [[s, t, *(repr(float(v) + 1e-9) for v in rest)] for s, t, *rest in rows]


def full_turns(rows: Rows) -> Rows:
    return [[s, t, x, y, repr(float(a) + 2.0 * np.pi), *rest] for s, t, x, y, a, *rest in rows]


CHANGES = [moved_in_time, reordered, one_row_less, off_the_grid, first_transition_only, one_segment, rounded, shaken, full_turns]


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return table(tmp_path_factory.mktemp("fit") / "fit.csv", 1)


def fitted_on(*paths: Path) -> ModelSpec:
    return ModelSpec("unicycle", DT, fitted_on=load_dataset(paths, MODEL).digests)


def changed(path: Path, change: Callable[[Rows], Rows], to: Path) -> Path:
    head, *rows = path.read_text().splitlines()
    to.write_text("\n".join([head, *(",".join(row) for row in change([row.split(",") for row in rows]))]) + "\n")
    return to


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_a_table_of_rows_that_the_fit_saw_is_refused_whatever_was_done_to_it(
    fit: Path, tmp_path: Path, change: Callable[[Rows], Rows]
) -> None:
    model = compose(fitted_on(fit))
    with pytest.raises(NotEnoughEvidence, match=r"fitted on (1 of its rows|this recording)"):
        refuse_fitted(model, load_transitions(changed(fit, change, tmp_path / "again.csv"), model))


@pytest.mark.slow
def test_a_merged_table_is_refused_with_the_share_of_seen_rows(fit: Path, tmp_path: Path) -> None:
    model, fresh = compose(fitted_on(fit)), table(tmp_path / "fresh.csv", 2)
    part = changed(fit, one_segment, tmp_path / "part.csv")
    refuse_fitted(model, load_transitions(fresh, model))
    with pytest.raises(NotEnoughEvidence, match=r"fitted on 0\.00826 of its rows \(50 of 6050\)"):
        refuse_fitted(model, load_transitions([fresh, part], model))


@pytest.mark.slow
def test_a_model_that_was_fitted_before_there_were_sketches_is_as_before(fit: Path, tmp_path: Path) -> None:
    spec = fitted_on(fit)
    model = compose(ModelSpec("unicycle", DT, fitted_on=tuple(one for one in spec.fitted_on if one.startswith("sha256:"))))
    refuse_fitted(model, load_transitions(changed(fit, shaken, tmp_path / "again.csv"), model))
    with pytest.raises(NotEnoughEvidence, match="fitted on this recording"):
        refuse_fitted(model, load_transitions(fit, model))


@pytest.mark.parametrize("step", [0.0, 2e-5, 1e-3, 0.02])
@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_fresh_recording_is_refused_no_more_often_than_said(step: float, width: int) -> None:
    """Of any sensor: continuous, or with steps smaller and larger than a cell; each run begins where odometry does."""
    refused, count = 0, 60
    for seed in range(count):
        rng = np.random.default_rng(seed)
        runs = [np.cumsum(rng.normal(size=(1500, width)), axis=0) / 40.0 for _ in range(2)]
        runs = [np.vstack([np.zeros(width), run + 1e-3 * rng.normal(size=run.shape)]) for run in runs]
        runs = [np.round(run / step) * step if step else run for run in runs]
        refused += seen(sketch(runs[:1], ())[0], runs[1:]).refused
    assert clopper_pearson_lower(refused, count, SURE) <= ALPHA


@pytest.mark.slow
def test_of_a_long_recording_a_bounded_sketch_finds_a_few_hundred_transitions() -> None:
    rng = np.random.default_rng(3)
    rows = rng.uniform(-1, 1, (500_000, 3))
    (text,) = sketch([rows], (2,))
    assert len(text) < 150_000
    part = rows[rng.choice(len(rows), 1200, replace=False)]
    found = seen(text, [part + 1e-9])
    assert found.refused
    assert abs(found.rows - 1200 * 2 * KEPT / len(rows)) < 40
    assert seen(text, [rng.uniform(-1, 1, (1200, 3))]) == (0, pytest.approx(80, abs=40), False)


def test_a_damaged_sketch_is_one_clear_error() -> None:
    for form in (PREFIX, COMPACT):
        (text,) = sketch([np.random.default_rng(4).normal(size=(100, 2))], (), form)
        for bad in (text[:-7], f"{form}!!", form):
            with pytest.raises(ConfigError, match="sketch of rows is damaged"):
                seen(bad, [np.zeros((3, 2))])


@pytest.mark.slow
def test_the_command_line_refuses_a_test_and_a_gap_on_seen_rows(fit: Path, tmp_path: Path) -> None:
    again, model = changed(fit, rounded, tmp_path / "again.csv"), tmp_path / "model.toml"
    model.write_text(dump_model(fitted_on(fit)))
    python = [sys.executable, "-m", "s2r_runtime"]
    gap = subprocess.run([*python, "gap", again, "--model", model], capture_output=True, text=True, timeout=100, check=False)
    assert gap.returncode == 3
    assert "6000 of 6000" in gap.stderr
    argv = [*python, "trace", fit, "--test", again, "--model", "unicycle", "--dt", str(DT)]
    trace = subprocess.run(argv, capture_output=True, text=True, timeout=100, check=False)
    assert trace.returncode == 2
    assert "has rows of it" in trace.stderr


@pytest.mark.parametrize(
    "change",
    [{"angles": (99,)}, {"angles": (-1,)}, {"cells": (0.0,) * 4}, {"cells": (math.nan,) * 4}, {"chance": math.nan}, {"chance": -1.0}],
)
def test_a_sketch_whose_numbers_are_none_is_one_clear_error_too(change: dict[str, Any]) -> None:
    runs = [np.random.default_rng(1).normal(size=(50, 3))]
    for form in (PREFIX, COMPACT):
        (text,) = sketch(runs, (2,), form)
        made = msgspec.msgpack.decode(base64.b64decode(text.removeprefix(form)))
        damaged = form + base64.b64encode(msgspec.msgpack.encode({**made, **change})).decode()
        with pytest.raises(ConfigError, match="sketch of rows is damaged"):
            seen(damaged, runs)


@pytest.mark.parametrize(
    "change", [{"n": 10**9}, {"n": -1}, {"n": 7}, {"low": 64}, {"low": -1}, {"shift": 64}, {"code": b""}, {"code": bytes(99)}]
)
def test_a_list_of_hashes_that_is_none_is_one_clear_error_too(change: dict[str, Any]) -> None:
    runs = [np.random.default_rng(1).normal(size=(50, 3))]
    (text,) = sketch(runs, (2,))
    made = msgspec.msgpack.decode(base64.b64decode(text.removeprefix(COMPACT)))
    made["grids"][1] |= change
    with pytest.raises(ConfigError, match="sketch of rows is damaged"):
        seen(COMPACT + base64.b64encode(msgspec.msgpack.encode(made)).decode(), runs)


# ---------------------------------------------------------------- as text


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("rows", [50, 6000])
def test_the_compact_form_finds_the_rows_that_the_former_one_finds(fit: Path, change: Callable[[Rows], Rows], rows: int) -> None:
    def runs(table: Rows) -> list[np.ndarray]:
        return [np.array([row[2:5] for row in part], dtype=np.float64) for part in by_segment(table)]

    table = [line.split(",") for line in fit.read_text().splitlines()[1:]][:rows]
    (former,), (compact,) = (sketch(runs(table), (2,), form) for form in (PREFIX, COMPACT))
    again = runs(change(table))
    assert seen(compact, again) == seen(former, again)
    assert seen(compact, again).refused


def test_a_model_of_twenty_fits_has_all_that_each_of_them_saw(tmp_path: Path) -> None:
    fits = [np.random.default_rng(seed).uniform(-1, 1, (20_000, 3)) for seed in range(20)]
    every: tuple[str, ...] = ("sha256:0",)
    for rows in fits:
        every = united(every, sketch([rows], (2,)))
    assert every == ("sha256:0", *(sketch([rows], (2,))[0] for rows in fits))
    (tmp_path / "model.toml").write_text(dump_model(ModelSpec("unicycle", DT, fitted_on=every)))
    assert load_model(tmp_path / "model.toml").fitted_on == every
    fresh = [np.random.default_rng(99).uniform(-1, 1, (20_000, 3))]
    assert not any(seen(text, fresh).refused for text in every[1:])


def test_of_a_hundred_fits_each_is_thinner_and_together_they_stay_within_their_bound() -> None:
    fits = [np.random.default_rng(seed).uniform(-1, 1, (20_000, 3)) for seed in range(100)]
    texts = united(*(sketch([rows], (2,)) for rows in fits))
    assert 0.8 * TEXT_MAX < sum(map(len, texts)) <= TEXT_MAX
    for text, rows in zip(texts, fits, strict=True):
        assert seen(text, [rows[:200] + 1e-9]).refused
        assert not seen(text, [fits[0][:200] if rows is not fits[0] else fits[1][:200]]).refused
    assert united(texts, texts[:3]) == texts


def test_sketches_of_earlier_versions_are_thinned_like_those_of_now() -> None:
    fits = [np.random.default_rng(seed).uniform(-1, 1, (20_000, 3)) for seed in range(30)]
    texts = united(*(sketch([rows], (2,), PREFIX) for rows in fits))
    assert form_of(texts) == COMPACT
    assert sum(map(len, texts)) <= TEXT_MAX
    assert all(seen(text, [rows[:200]]).refused for text, rows in zip(texts, fits, strict=True))


def test_hashes_agree_by_chance_no_more_often_than_said() -> None:
    rng = np.random.default_rng(5)
    (text,) = sketch([rng.uniform(-1, 1, (KEPT - 1, 6))], ())
    found, looked = 0, 0
    for _ in range(20):
        result = seen(text, [rng.uniform(-1, 1, (100_000, 6))])
        found, looked = found + result.rows, looked + result.of
        assert not result.refused
    assert clopper_pearson_lower(found, looked, SURE) <= 2.0 * 2.0**-FALSE_BITS
