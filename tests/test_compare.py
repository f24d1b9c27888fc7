"""`s2r compare`: paired outcomes from a table or from logs, one answer, its exit code, and one line for whatever is wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.cli.main import main
from s2r_runtime.errors import NotEnoughEvidence, RecordingError, UsageError
from s2r_runtime.evidence.compared_runs import Compared, Outcome
from s2r_runtime.evidence.logged_deployments import Run
from s2r_runtime.evidence.run_pairs import from_logs, from_table
from s2r_runtime.evidence.scores import SAFE, Score
from s2r_runtime.evidence.trials import Found, values_of

HEADER = "scenario,old,new\n"


def table(folder: Path, a: np.ndarray, b: np.ndarray) -> str:
    path = folder / "outcomes.csv"
    path.write_text(HEADER + "".join(f"{k},{x:g},{y:g}\n" for k, (x, y) in enumerate(zip(a, b, strict=True))))
    return str(path)


def outcomes(p: float, n: int, seed: int) -> np.ndarray:
    return (np.random.default_rng(seed).random(n) < p).astype(np.float64)


def ran(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main(["compare", *arguments])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_the_answer_is_the_exit_code_and_the_first_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path, outcomes(0.9, 120, 1), outcomes(0.4, 120, 2))
    code, out, _ = ran(capsys, "old", "new", "--table", path)
    assert code == 1
    assert out.startswith("new is worse than old (confidence 95 %, shown at pair ")
    code, out, _ = ran(capsys, "new", "old", "--table", path)
    assert code == 0
    assert out.startswith("old is better than new (confidence 95 %")
    even = table(tmp_path, outcomes(0.6, 20, 3), outcomes(0.6, 20, 4))
    code, out, _ = ran(capsys, "old", "new", "--table", even)
    assert code == 3
    assert out.startswith("Not decided after 20 pairs whether new is worse than old: drive more pairs.")


def test_json_has_what_the_page_lists(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = outcomes(0.9, 120, 1), outcomes(0.4, 120, 2)
    code, out, _ = ran(capsys, "old", "new", "--table", table(tmp_path, a, b), "--json", "--delta", "0.1", "--beta", "0.01")
    found: dict[str, Any] = json.loads(out)
    assert (code, found["answer"], found["delta"], found["beta"]) == (1, "worse", 0.1, 0.01)
    assert (found["n"], found["pair"], found["unpaired"], found["left_out"], found["outside_range"]) == (120, "row", [0, 0], {}, 0)
    assert found["a"] == pytest.approx(a.mean())
    assert found["difference"] == pytest.approx(a.mean() - b.mean())
    assert found["lower"] < found["difference"] < found["upper"]
    assert found["e_worse"] >= found["e_required"] == pytest.approx(200.0)


def test_scores_are_reported_in_their_own_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Seconds: lower is better, a lap that never ended counts as the slowest."""
    rng = np.random.default_rng(5)
    a, b = rng.uniform(20.0, 30.0, 60), rng.uniform(30.0, 40.0, 60)
    b[7] = math.nan
    path = table(tmp_path, a, b)
    code, out, err = ran(capsys, "old", "new", "--table", path, "--range", "0", "60", "--better", "low", "--delta", "2", "--json")
    found = json.loads(out)
    assert code == 1
    assert found["outside_range"] == 1
    assert found["a"] == pytest.approx(a.mean())
    assert found["b"] == pytest.approx((np.nansum(b) + 60.0) / 60)
    assert found["difference"] == pytest.approx(found["b"] - found["a"])
    assert found["score"] == {"name": "score", "low": 0.0, "high": 60.0, "better": "low"}
    assert err == (
        "s2r: B: 1 of 60 values of 'score' are outside the declared range 0 to 60 (the first: nan in pair 8); "
        "each counts as the worst value, 60\n"
    )


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("old,new\n1,x\n", "line 2: new is 'x', must be a number, true or false"),
        ("old,new\n1\n", "line 2: new is empty, must be a number, true or false"),
        ("old,other\n1,1\n", "has no column 'new'; its columns are: old, other"),
        ("old,new,new\n1,1,1\n", "has more than one column 'new'"),
        ("", "has no column 'old'; its columns are: none"),
    ],
)
def test_a_table_that_cannot_be_read_gets_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, line: str) -> None:
    path = tmp_path / "outcomes.csv"
    path.write_text(text)
    code, out, err = ran(capsys, "old", "new", "--table", str(path))
    assert (code, out) == (2, "")
    assert line in err
    assert err.count("\n") == 1


def test_cells_may_be_true_and_false_and_rows_may_be_empty(tmp_path: Path) -> None:
    path = tmp_path / "outcomes.csv"
    path.write_bytes("\ufeffold , new\nTrue,false\n\n 1 ,0.5\n".encode())
    assert from_table(path, "old", "new") == ((1.0, 1.0), (0.0, 0.5), (0, 0))
    path.write_bytes(b"old,new\n")
    with pytest.raises(NotEnoughEvidence, match="has no rows"):
        from_table(path, "old", "new")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match="is not UTF-8 text"):
        from_table(path, "old", "new")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["a.py", "b.py", "x.mcap"], "--profile is needed with logs"),
        (["a.py", "b.py", "--profile", "p.toml", "--a-log", "x.mcap"], "no log of B's runs"),
        (["old", "new", "x.mcap", "--table", "o.csv"], "LOG does not go with --table"),
        (["old", "new", "--table", "o.csv", "--score", "safe"], "--score does not go with --table"),
        (["a.py", "b.py", "x.mcap", "--range", "0", "2"], "--range and --better go with another score than safe"),
        (["old", "new", "--table", "o.csv", "--range", "2", "2"], "must be finite and ascending"),
        (["old", "new", "--table", "nowhere.csv"], "nowhere.csv: cannot be read"),
    ],
)
def test_a_call_that_is_wrong_gets_one_line(capsys: pytest.CaptureFixture[str], arguments: list[str], line: str) -> None:
    code, out, err = ran(capsys, *arguments)
    assert code == (78 if "cannot be read" in line else 2)
    assert line in err
    assert (out, err.count("\n")) == ("", 1)


def test_a_margin_beyond_the_range_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = ran(capsys, "old", "new", "--table", table(tmp_path, np.ones(3), np.ones(3)), "--delta", "1")
    assert (code, "must be below the length of the score's range, 1" in err) == (2, True)


def runs(*given: tuple[int, int, bool | None]) -> Compared:
    """seed, index, safe (None: censored)."""
    outcome: dict[bool | None, Outcome] = {True: "safe", False: "unsafe", None: "censored"}
    return Compared(
        [(Run(index, 10 * index, seed=seed, safety=float(bool(safe)), progress=0.5), outcome[safe]) for seed, index, safe in given], {}
    )


def test_runs_in_the_same_scenario_are_a_pair_in_the_order_of_the_first() -> None:
    a = runs((1, 0, True), (1, 1, False), (2, 0, True), (1, 3, True))
    b = runs((1, 3, False), (1, 1, True), (1, 0, True), (9, 9, True))
    assert from_logs(a, b, SAFE, "scenario") == ((1.0, 0.0, 1.0), (1.0, 1.0, 0.0), (1, 1))
    assert from_logs(a, runs((5, 0, False), (5, 1, True)), SAFE, "order") == ((1.0, 0.0), (0.0, 1.0), (2, 0))


def test_a_censored_run_is_a_pair_even_without_a_partner() -> None:
    a = runs((1, 0, True), (1, 1, None), (1, 2, None), (1, 4, True))
    b = runs((1, 0, None), (1, 1, False), (1, 3, None))
    assert from_logs(a, b, SAFE, "scenario") == ((1.0, None, None, None), (None, 0.0, None, None), (1, 0))


def test_without_a_common_scenario_the_line_says_what_would_pair_them() -> None:
    with pytest.raises(NotEnoughEvidence, match=r"2 runs of A and 1 of B count, none in a common scenario .*; --pair order pairs them"):
        from_logs(runs((1, 0, True), (1, 1, True)), runs((2, 0, True)), SAFE, "scenario")
    with pytest.raises(NotEnoughEvidence, match="0 runs of A and 1 of B count, none to make a pair of"):
        from_logs(runs(), runs((2, 0, True)), SAFE, "scenario")


def test_a_run_that_the_gate_ended_scores_the_worst_value_whatever_it_had_reached() -> None:
    found = Found([(run, outcome == "safe") for run, outcome in runs((1, 0, True), (1, 1, False)).runs])
    found.counted[1][0].closed = True
    found.counted[0][0].progress = None
    assert values_of(found, SAFE) == [1.0, 0.0]
    assert values_of(found, Score("safety", -1.0, 2.0)) == [1.0, -1.0]
    assert math.isnan(values_of(found, Score("progress"))[0])
    assert values_of(found, Score("progress", better="low"))[1] == 1.0
    with pytest.raises(UsageError, match="must be one of: safe, safety, progress"):
        values_of(found, Score("speed"))
