"""A model file of the user's own: it is a model like any other, and what it does wrong is told with its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.pipeline import load_dataset

HEAD = 'import sys\nimport numpy as np\nSTATES = ("x", "v")\nINPUTS = ("force",)\nPARAMS = {"mass": 2.0}\n'
STEP = "def step(x, u, dt, params):\n    "
GOOD = 'return np.column_stack([x[:, 0] + dt * x[:, 1], x[:, 1] + dt * u[:, 0] / params["mass"]])\n'


def model(tmp_path: Path, text: str) -> ComposedModel:
    path = tmp_path / "own.py"
    path.write_text(text)
    return compose(ModelSpec(str(path), 0.1))


def test_a_file_is_a_model(tmp_path: Path) -> None:
    after, _ = model(tmp_path, HEAD + STEP + GOOD).step(np.array([[1.0, 2.0]]), np.array([[4.0]]), ())
    assert after[0] == pytest.approx([1.2, 2.2])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + "sys.exit(0)\n" + STEP + GOOD, r"own\.py, line 6: loading it ended the program"),
        (HEAD + "1 / 0\n" + STEP + GOOD, r"own\.py, line 6: loading it raised ZeroDivisionError"),
        (HEAD + "def step(:\n", r"own\.py, line 6: loading it raised SyntaxError"),
        (HEAD, r"own\.py: lacks step"),
        (HEAD + "step = 3\n", r"own\.py: step is 3, must be a function"),
        (HEAD + 'PARAMS = {"mass": "heavy"}\n' + STEP + GOOD, r"own\.py: PARAMS must be a dict of numbers"),
        (HEAD + "STATES = 2\n" + STEP + GOOD, r"own\.py: STATES is 2, must be a tuple of names"),
        (HEAD + "UNITS = ('m',)\n" + STEP + GOOD, r"own\.py: UNITS is \('m',\), must be a dict"),
        (HEAD + "UNITS = {'x': 1}\n" + STEP + GOOD, r"own\.py: UNITS is \{'x': 1\}, must be a dict .* as text"),
        (HEAD + "UNITS = {'y': 'm'}\n" + STEP + GOOD, r"own\.py: UNITS names 'y', must name states and inputs: x, v, force"),
    ],
)
def test_a_file_that_is_no_model_is_refused_with_its_place(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        model(tmp_path, text)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("raise KeyError('zz')\n", r"own\.py, line 7: step raised KeyError: 'zz'"),
        ("sys.exit(0)\n", r"own\.py, line 7: step ended the program"),
        ("return np.zeros((len(x), 3))\n", r"step returned shape \(2, 3\), must be \(2, 2\)"),
        ("y = x.copy(); y[1, 1] = np.nan; return y\n", r"step returned nan for state 'v' in row 1 .*must be finite"),
        ("return x / 0.0\n", r"step returned inf for state 'x' in row 0"),
    ],
)
def test_a_step_that_fails_is_told_with_its_place(tmp_path: Path, body: str, words: str) -> None:
    own = model(tmp_path, HEAD + STEP + body)
    with pytest.raises(ConfigError, match=words):
        own.step(np.ones((2, 2)), np.ones((2, 1)), ())


def test_what_is_not_finite_already_is_not_the_files_fault(tmp_path: Path) -> None:
    after, _ = model(tmp_path, HEAD + STEP + GOOD).step(np.array([[np.inf, 1.0]]), np.ones((1, 1)), ())
    assert after[0, 0] == np.inf


def test_what_a_file_prints_goes_to_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model(tmp_path, HEAD + 'print("loading")\n' + STEP + 'print("stepping"); ' + GOOD).step(np.ones((1, 2)), np.ones((1, 1)), ())
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "loading\nstepping\n"


def test_the_same_rows_are_asked_once_and_what_a_caller_does_to_the_result_is_his(tmp_path: Path) -> None:
    own = model(tmp_path, HEAD + "CALLS = []\n" + STEP + "CALLS.append(1)\n    " + GOOD)
    x, u = np.array([[1.0, 2.0]]), np.array([[4.0]])
    calls = own.nominal.shared.function.__globals__["CALLS"]  # type: ignore[attr-defined]
    first = own.nominal.step(x, u, 0.1, own.nominal.parameters)
    first[:] = 9.0
    before = len(calls)
    assert own.nominal.step(x.copy(), u.copy(), 0.1, own.nominal.parameters)[0] == pytest.approx([1.2, 2.2])
    assert len(calls) == before
    assert own.nominal.step(x, u, 0.2, own.nominal.parameters)[0] == pytest.approx([1.4, 2.4])
    assert own.nominal.step(x, u, 0.1, {"mass": 4.0})[0] == pytest.approx([1.2, 2.1])
    assert len(calls) == before + 2


def test_a_copy_with_another_step_remembers_nothing_of_the_first(tmp_path: Path) -> None:
    own = model(tmp_path, HEAD + STEP + GOOD).nominal.shared
    x, u = np.array([[1.0, 2.0]]), np.array([[4.0]])
    assert own.step(x, u, 0.1, own.parameters)[0] == pytest.approx([1.2, 2.2])
    other = replace(own, function=lambda x, u, dt, params: x)  # type: ignore[type-var]
    assert other.step(x, u, 0.1, own.parameters)[0] == pytest.approx([1.0, 2.0])


def test_a_step_in_place_changes_nothing_of_its_callers(tmp_path: Path) -> None:
    """Nor does it step farther when it is asked once more."""
    own = model(tmp_path, HEAD + STEP + "x[:, 0] += dt * x[:, 1]\n    u *= dt / params.pop('mass')\n    x[:, 1] += u[:, 0]\n    return x\n")
    x, u = np.array([[1.0, 2.0]]), np.array([[4.0]])
    for _ in range(2):
        assert own.nominal.step(x, u, 0.1, own.nominal.parameters)[0] == pytest.approx([1.2, 2.2])
        assert (x.tolist(), u.tolist(), own.nominal.parameters) == ([[1.0, 2.0]], [[4.0]], {"mass": 2.0})


def test_units_that_the_file_says_are_those_of_effects(tmp_path: Path) -> None:
    own = model(tmp_path, HEAD + 'UNITS = {"x": "m", "force": "kN"}\n' + STEP + GOOD)
    limit = registry().get("effects", "input_rate_limit")
    assert own.nominal.units == {"x": "m", "force": "kN"}
    assert limit.unit(own.nominal, "force", "rate") == "kN/s"
    assert limit.unit(model(tmp_path, HEAD + STEP + GOOD).nominal, "force", "rate") == "input's unit/s"


@pytest.mark.parametrize(
    "body",
    [
        'return [float(x[0]) + dt * float(x[1]), float(x[1]) + dt * float(u[0]) / params["mass"]]\n',
        'return np.array([x[0] + dt * x[1], x[1] + dt * (u[0] if np.ndim(u) == 1 else u[0, 0]) / params["mass"]])\n',
        'return np.array([x[0] + dt * x[1], x[1] + dt * u[0] / params["mass"]])\n',
    ],
)
def test_a_step_that_takes_one_state_is_told_so_at_once(tmp_path: Path, body: str) -> None:
    with pytest.raises(ConfigError, match=r"own\.py: step takes one state at a time, .* x is \(n, 2\), u is \(n, 1\)"):
        model(tmp_path, HEAD + STEP + body)


def test_a_step_that_always_fails_is_asked_a_few_times(tmp_path: Path) -> None:
    own = model(tmp_path, HEAD + "CALLS = []\n" + STEP + 'CALLS.append(1)\n    return x + params["mas"]\n')
    rows = [f"{0.1 * k:.1f},{0.01 * k},{0.1},{k % 5}" for k in range(300)]
    (tmp_path / "run.csv").write_text("\n".join(["t,x,v,force", *rows]) + "\n")
    before = len(own.nominal.shared.function.__globals__["CALLS"])  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"own\.py, line 9: step raised KeyError: 'mas'"):
        load_dataset(tmp_path / "run.csv", own)
    assert len(own.nominal.shared.function.__globals__["CALLS"]) - before < 20  # type: ignore[attr-defined]


def test_a_step_that_gives_no_numbers_at_rest_is_no_step_that_fails(tmp_path: Path) -> None:
    own = model(tmp_path, HEAD + STEP + "return np.column_stack([x[:, 0] + dt * x[:, 1], x[:, 1] + dt * u[:, 0] / x[:, 1]])\n")
    moving = [0.0 if k in (0, 150, 299) else 1.0 + 0.01 * k for k in range(300)]
    rows = [f"{0.1 * k:.1f},{0.01 * k},{v},{k % 5}" for k, v in enumerate(moving)]
    (tmp_path / "run.csv").write_text("\n".join(["t,x,v,force", *rows]) + "\n")
    assert load_dataset(tmp_path / "run.csv", own).rows == 300
