"""Signal temporal logic: the values of its operators, and what is said about text that is no formula."""

from __future__ import annotations

import importlib.util
import random

import numpy as np
import pytest
import stl_random

from s2r_runtime.errors import ConfigError
from s2r_runtime.tasks.stl.robustness import Formula
from s2r_runtime.tasks.stl.syntax import positive
from s2r_runtime.tasks.stl.text import parse_expression

NAMES = ("x", "y", "z")


def traces(rng: random.Random, steps: int, runs: int) -> dict[str, np.ndarray]:
    return {name: np.array([[round(rng.uniform(-3.0, 3.0), 3) for _ in range(runs)] for _ in range(steps)]) for name in NAMES}


def one(signals: dict[str, np.ndarray], run: int) -> dict[str, list[float]]:
    return {name: values[:, run].tolist() for name, values in signals.items()}


@pytest.mark.parametrize("seed", range(4))
def test_random_formulas_have_the_values_of_the_definition_at_every_sample_of_every_trace(seed: int) -> None:
    rng = random.Random(seed)
    for _ in range(500):
        node, dt = stl_random.random_formula(rng, rng.randint(0, 3), 6), rng.choice((1.0, 0.033, 0.1))
        signals = traces(rng, rng.randint(1, 12), rng.choice((1, 2, 60) if rng.random() < 0.05 else (1, 2)))
        formula = Formula.parse(stl_random.text(node, dt), NAMES, dt)
        found = formula.robustness(signals, whole=True)
        told = [[stl_random.naive(node, one(signals, run), k) for run in range(found.shape[1])] for k in range(len(found))]
        assert np.array_equal(found, np.array(told)), stl_random.text(node, dt)
        assert np.array_equal(formula.robustness(signals), found[0]), stl_random.text(node, dt)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::SyntaxWarning", "ignore::ResourceWarning")  # of its parser generator
@pytest.mark.skipif(importlib.util.find_spec("rtamt") is None, reason="rtamt is not installed (pip install '.[bench]')")
def test_random_formulas_have_the_values_that_rtamt_gives() -> None:
    rng = random.Random(7)
    for _ in range(200):
        node = stl_random.random_formula(rng, rng.randint(0, 4))
        signals = traces(rng, 30, 1)
        found = Formula.parse(stl_random.text(node), NAMES, 1.0).robustness(signals, whole=True)[:, 0]
        np.testing.assert_allclose(found, stl_random.rtamt_robustness(node, one(signals, 0)), rtol=1e-12, atol=1e-12)


def test_many_runs_have_the_values_of_each_by_itself() -> None:
    rng = np.random.default_rng(8)
    signals = {name: rng.standard_normal((20, 613)) for name in NAMES}
    for text in ("always (x > -3) and eventually[2,9] always[0,3] (y > 0)", "x > -2 until[1,8] y > 1", "x > y"):
        formula = Formula.parse(text, NAMES, 1.0)
        alone = [formula.robustness({name: v[:, k : k + 1] for name, v in signals.items()}, whole=True) for k in range(613)]
        assert np.array_equal(formula.robustness(signals, whole=True), np.concatenate(alone, axis=1))


def test_the_form_without_not_above_intervals_has_the_same_values() -> None:
    rng = random.Random(3)
    for _ in range(300):
        formula = Formula.parse(stl_random.text(stl_random.random_formula(rng, 4)), NAMES, 1.0)
        signals = traces(rng, 15, 2)
        assert np.array_equal(Formula(positive(formula.truth)).robustness(signals), formula.robustness(signals))


def test_long_windows_cost_no_more_than_short_ones_and_have_the_right_values() -> None:
    rng = np.random.default_rng(5)
    for runs in (1, 100):
        x = rng.standard_normal((400, runs))
        for first, last in ((0, 0), (0, 399), (3, 150), (399, 500), (500, 600), (0, 1)):
            found = Formula.parse(f"always[{first},{last}] (x > 0)", NAMES, 1.0).robustness({"x": x}, whole=True)
            told = [x[k + first : k + last + 1].min(axis=0, initial=np.inf) for k in range(400)]
            assert np.array_equal(found, told)


def test_precedence_is_as_documented() -> None:
    signals = {name: np.array([[value], [-value]]) for name, value in (("x", 1.0), ("y", 2.0), ("z", 4.0))}
    for left, right in (
        ("always x > 0 and y > 0", "(always (x > 0)) and (y > 0)"),
        ("not x > 0 or y > 0", "(not (x > 0)) or (y > 0)"),
        ("x > 0 or y > 0 and z > 9", "(x > 0) or ((y > 0) and (z > 9))"),
        ("x > 0 implies y > 0 implies z > 9", "(x > 0) implies ((y > 0) implies (z > 9))"),
        ("x > 9 and y > 0 until[0,1] z > 0", "(x > 9) and ((y > 0) until[0,1] (z > 0))"),
        ("-x^2 < y", "(0 - (x^2)) < y"),
        ("x - y - z < 2 * x / y", "((x - y) - z) < ((2 * x) / y)"),
        ("0 < x <= y", "(0 < x) and (x <= y)"),
        ("!(x>0) && y>0 || z>0 -> x>0", "(((not (x>0)) and (y>0)) or (z>0)) implies (x>0)"),
        ("eventually[0:1] x > 0", "eventually[0, 1] (x > 0)"),
    ):
        a, b = (Formula.parse(text, NAMES, 1.0).robustness(signals, whole=True) for text in (left, right))
        assert np.array_equal(a, b), left


def test_expressions_compute_what_numpy_computes() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0.1, 0.9, (2, 5))
    for text, told in (
        ("hypot(x, y, 3)", np.sqrt(x * x + y * y + 9.0)),
        ("wrap(x + 3 * pi)", (x + 3 * np.pi + np.pi) % (2 * np.pi) - np.pi),
        ("min(x, y, 0.5) + max(x, y)", np.minimum(np.minimum(x, y), 0.5) + np.maximum(x, y)),
        ("atan2(y, x) / sqrt(x) ** 2", np.arctan2(y, x) / x),
        ("2 ^ 3 ^ 2 - exp(log(x))", 512.0 - x),
        ("1.5e1 + .5", np.full(5, 15.5)),
    ):
        parse_expression(text, ("x", "y"), "expression")
        found = Formula.parse(f"{text} >= 0", ("x", "y"), 1.0).robustness({"x": x[None], "y": y[None]})
        np.testing.assert_allclose(found, told, rtol=1e-12)


def test_what_is_no_number_counts_as_a_violation() -> None:
    x = np.array([[1.0, 1.0, 1.0], [-1.0, 4.0, np.nan], [1.0, 1.0, 1.0]])
    for text in ("always (sqrt(x) >= 0)", "not eventually (sqrt(x) < 0)", "always[0,2] (log(x) > -9)", "sqrt(x) >= 0 until x > 3"):
        found = Formula.parse(text, ("x",), 1.0).robustness({"x": x})
        assert (found >= 0.0).tolist() == [False, True, False], text


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "column 1: is empty"),
        ("x < ", "column 4: expected a name, a number or '(', found the end"),
        ("x < 2 and", "column 10: expected a name, a number or '(', found the end"),
        ("(x < 2", "column 7: expected ')' for the bracket at column 1, found the end"),
        ("x < 2)", "column 6: ')' does not belong here"),
        ("x", "column 1: a formula is needed, and here stands a number"),
        ("always x", "column 8: 'always' joins formulas and here stands a number"),
        ("x and y > 0", "column 1: 'and' joins formulas and here stands a number"),
        ("1 + (x < 2) < 3", "column 8: '+' takes numbers and here stands a formula"),
        ("xx > 1 and q > 0", "column 1: 'xx' is not known; did you mean 'x'?"),
        ("q > 0", "column 1: 'q' is not known; there are: x, y, z"),
        ("alway (x > 0)", "column 1: 'alway' is no function; did you mean 'always'?"),
        ("abs > 0", "column 1: abs is a function: abs(...)"),
        ("atan2(x) > 0", "column 1: atan2 has 1 arguments, must have 2"),
        ("always[5,2] (x > 0)", "column 7: the interval of always ends before it begins: [5, 2]"),
        ("always[0.01,0.02] (x > 0)", "column 7: the interval [0.01, 0.02] s of always holds no sample of a step of 0.1 s"),
        ("always[0 5] (x > 0)", "column 10: expected ',' between the bounds of always, found '5'"),
        ("always[0,x] (x > 0)", "column 10: the bounds of always are seconds, numbers >= 0; found 'x'"),
        ("always[-1,2] (x > 0)", "column 8: the bounds of always are seconds, numbers >= 0; found '-'"),
        ("x > 0 ; y > 0", "column 7: ';' means nothing in a formula"),
        ("(" * 200 + "x > 0" + ")" * 200, "column 41: is nested deeper than 40 levels"),
        ("x + " * 300 + "x > 0", "is the operand of more than 200 operators"),
        ("x > 0 or " * 4000 + "x > 0", "characters, a formula has at most 20000"),
    ],
)
def test_text_that_is_no_formula_is_refused_on_one_line_that_points_at_the_column(text: str, told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Formula.parse(text, NAMES, 0.1, "metric")
    assert told in str(caught.value)
    assert str(caught.value).startswith("metric")
    assert "\n" not in str(caught.value)


def test_any_text_is_a_formula_or_a_configuration_error() -> None:
    rng = random.Random(11)
    pieces = [*"()[],<>=!&|+-*/^ :.", "always", "until", "and", "x", "y", "1", "2.5", "abs", "pi", "not", "->", "\n", "é"]
    for _ in range(3000):
        text = "".join(rng.choice(pieces) for _ in range(rng.randint(0, 14)))
        try:
            Formula.parse(text, NAMES, 0.1)
            told = ""
        except ConfigError as error:
            told = str(error)
        assert "\n" not in told.replace(text, "")


def test_long_chains_do_not_exhaust_the_stack() -> None:
    x = np.ones((3, 2))
    for text in (" and ".join(["x > 0"] * 1000), " + ".join(["x"] * 190) + " > 0"):
        assert np.all(Formula.parse(text, NAMES, 1.0).robustness({"x": x}) > 0.0)
