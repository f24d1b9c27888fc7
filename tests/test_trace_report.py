"""What a person sees of a trace: the account and the page, for each of the five verdicts and on several models."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pages_rig import needs_chromium, rendered, self_contained
from trace_robots import GEOMETRY, commands, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.report.trace_page import trace_page
from s2r_runtime.report.trace_section import add_trace
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.design.suggest import suggest
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.reporting.figures import envelope, spread, stretches
from s2r_runtime.trace.reporting.found import Found, each_once, interval_text
from s2r_runtime.trace.reporting.text import _assumed, loud
from s2r_runtime.trace.reporting.wording import in_words

DT, NOISE, STEPS = 0.05, np.array([0.001, 0.001, 0.004]), 900
BOUNDS = [(-0.5, 0.5), (-2.0, 2.0)]
ARCS = (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)
UNICYCLE = compose(ModelSpec("unicycle", DT, {}, ARCS))
VERDICTS = ("none", "traced", "ambiguous", "unexplained", "sensor_fault")


def _turning_gain(x, v, w):
    return v * (1 + 0.3 * np.cos(x[:, 2])), w * (1 + 0.3 * np.cos(x[:, 2])), 0.0, 0.0


def _data(verdict):
    rng = np.random.default_rng(5)
    u = commands(rng, 1, STEPS, DT, BOUNDS)
    if verdict == "ambiguous":
        u[0, :, 0] = 0.2
        u[0, :, 1] = np.repeat(rng.integers(0, 2, STEPS // 30), 30)
    effects = [("input_gain", "w", {"gain": 0.8})] if verdict in {"traced", "ambiguous"} else []
    if verdict == "traced":
        effects.append(("input_lag", "v", {"time_constant": 0.2}))
    y = drive(rng, "unicycle", u, effects, DT, NOISE, _turning_gain if verdict == "unexplained" else None)
    if verdict == "sensor_fault":
        y[0, 500:, 0] += 0.4
    return from_arrays(UNICYCLE, [(y[0], u[0])], "drive.csv")


@pytest.fixture(scope="module")
def results():
    """verdict -> result."""
    return {verdict: trace(_data(verdict), UNICYCLE) for verdict in VERDICTS}


@pytest.mark.slow
def test_what_no_rollout_shows_is_told_beside_a_name_and_takes_nothing_from_it(results):
    r = replace(results["traced"], depends_on=("w",), may_depend_on=("w",))
    assert r.text().splitlines()[0].endswith("explain the residual")
    assert "remaining   none above noise" in r.text()
    assert "may depend on w" in " ".join(r.text().split())
    assert r.to_json()["may_depend_on"] == ["w"]
    assert "what it may depend on" in trace_page(r)


@pytest.fixture(scope="module")
def pages(results):
    """verdict -> page."""
    return {verdict: trace_page(result) for verdict, result in results.items()}


def test_a_rival_that_two_explanations_share_is_listed_once():
    delay, again, slip = (
        Found(name, channel, {key: (value, None, None, "s")})
        for name, channel, key, value in (
            ("input_delay", "steer_cmd", "delay", 0.1587),
            ("input_delay", "steer_cmd", "delay", 0.1586),
            ("lateral_slip", "*", "coefficient", -0.05),
        )
    )
    assert each_once([delay, again, slip]) == (delay, slip)


@pytest.mark.slow
@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_account_opens_with_the_verdict_and_fits_a_terminal(results, verdict):
    text = results[verdict].text()
    assert text.startswith(f"{verdict}: ")
    assert max(len(line) for line in text.splitlines()) <= 100
    assert len(text.splitlines()) <= 45
    assert "held-out" in text
    assert "theta (deg)" in text


@pytest.mark.slow
def test_the_account_says_what_was_left_over_and_what_it_followed(results):
    text = results["traced"].text()
    left = text[text.index("\nresidual ") : text.index("error, rms")]
    assert re.search(r"theta: [\d.]+ times the noise in one step; (9\d|100) % of that follows w", left)
    assert re.search(r"along the heading: [\d.]+ times the noise in one step; \d+ % of that\s+follows how v changes", left)
    assert re.search(r"prediction\s+error\s+of\s+\w+\s+after\s+1 s: [\d.]+ times\s+the\s+noise", left)


@pytest.mark.slow
def test_the_account_says_what_explains_it_with_numbers_units_and_intervals(results):
    text = results["traced"].text()
    assert re.search(r"input_gain on w: gain = 0\.[78]\d+ \(95 %: 0\.\d+ to 0\.8\d+\)", text)
    assert "w does 80 % of what is commanded" in text
    assert re.search(r"time_constant = 0\.\d+ s \(95 %", text)
    assert re.search(r"theta \(rad\) +\S+ -> \S+ +\S+ +\S+ -> \S+", text)
    assert re.search(r"gap +[\d.]+ -> [\d.]+", text)
    assert "remaining   none above noise" in text


@pytest.mark.slow
def test_a_tie_lists_its_rivals_and_what_to_drive(results):
    r = results["ambiguous"]
    assert len(r.rivals) >= 1
    text = r.text()
    assert f"{1 + len(r.rivals)} explanations are not distinguishable" in text
    assert text.index("not distinguishable from") < text.index("try next    Drive w")
    assert "--suggest FILE.csv" in text


@pytest.mark.slow
def test_what_has_no_name_gets_none_and_nothing_is_said_to_have_changed(results):
    text = results["unexplained"].text()
    assert "that no effect in the library explains" in text
    assert "structure that depends on heading" in text
    assert "->" not in text[text.index("error, rms") :]
    assert re.search(r"\d+ % of it, noise included, is (v|w) times\s+a\s+factor that follows the\s+heading", text)


@pytest.mark.slow
def test_structure_without_a_name_is_not_counted_as_noise(results):
    """The sensors' noise is known here, and nothing pushes the robot: a rollout that begins and ends at measured rows is off by twice
    its variance. The structure's own rollouts end some thirty times as far.
    """
    r = results["unexplained"]
    truth = math.sqrt(2.0) * NOISE[2]
    assert 0.9 < r.floor[0][2] / truth < 1.2
    assert 0.9 < r.floor[1][2] / truth < 2.0
    assert r.before.ends[:, 2].std() > 10.0 * r.floor[1][2]


@pytest.mark.slow
def test_faults_are_told_with_their_times(results):
    text = results["sensor_fault"].text()
    assert re.search(r"faults +offset_jump of x from 25.000 to 45.000 s", text)
    assert "none: " not in text


@pytest.mark.slow
def test_the_json_tells_every_key_of_its_page_and_no_other(results):
    row = next(line for line in (Path(__file__).parents[1] / "docs" / "json.md").read_text().splitlines() if line.startswith("| `trace` |"))
    words = set(re.findall(r"`([a-z_]+)`", row))
    for result in results.values():
        told = result.to_json()
        assert set(told) - words == set()
        assert {"verdict", "effects", "candidates", "ambiguous_with", "depends_on", "error", "gap", "faults", "n_fit", "n_test"} <= set(
            told
        )
    assert all("same_thing" in e for e in results["ambiguous"].to_json()["ambiguous_with"])


@pytest.mark.slow
def test_the_same_thing_under_another_name_is_no_rival(results):
    """A unicycle's gain of w is its track_scale."""
    gain = Found("input_gain", "w", {"gain": (0.8, 0.79, 0.81, "-")})
    other = Found("track_scale", "theta", {"gain": (0.8, None, None, "-")}, (("input_gain", "w"),), same_thing=True)
    limit = Found("input_saturation", "w", {"high": (0.8, None, None, "rad/s")})
    result = results["traced"]
    for verdict, ambiguous_with, rivals in (("traced", (other,), ()), ("ambiguous", (other, limit), (limit,))):
        told = type(result)(
            **{
                **_fields(result),
                "verdict": verdict,
                "effects": (gain,),
                "ambiguous_with": ambiguous_with,
                "suggested_excitation": "Drive w.",
            }
        )
        assert told.rivals == rivals
        assert told.text().count("the same thing on this model: track_scale on theta") == 1
        assert [e["same_thing"] for e in told.to_json()["ambiguous_with"]] == [True, False][: len(ambiguous_with)]
        page = Page("", "")
        add_trace(page, told.to_json())
        assert page.html().count("the same thing on this model") == 1


@pytest.mark.slow
@pytest.mark.parametrize("left", [(), ("noise",)])
def test_a_page_says_of_what_a_name_may_depend_on_no_more_than_that(results, left):
    told = {**results["traced"].to_json(), "depends_on": [*left, "time"], "may_depend_on": ["time"]}
    page = Page("", "")
    add_trace(page, told)
    assert "something may depend on time: look at the name again" in page.html()
    assert [line for line in ("depends on: noise", "depends on: time") if line in page.html()] == ["depends on: noise"][: len(left)]


def _fields(result):
    return {name: getattr(result, name) for name in type(result).__dataclass_fields__}


@pytest.mark.parametrize(
    ("value", "low", "high", "unit", "text"),
    [
        (0.1, 0.0951, 0.1049, "s", "0.100 s (95 %: 0.095 to 0.105)"),
        (0.05, 0.04, 0.06, "rad", "0.05 rad (2.9 deg) (95 %: 0.04 to 0.06)"),
        (0.47, 0.0, 5.0, "s", "0.5 s (95 %: 0 to 5)"),
        (-0.04, -0.6, 0.6, "m", "-0.04 m (95 %: -0.6 to 0.6)"),
        (1e-12, 0.0, 1.0, "s", "0.000 s (95 %: 0.0 to 1.0)"),
        (0.8, None, None, "-", "0.8"),
        (1.5, 1.2, 1e6, "m/s", "1.5 m/s (at least 1.2)"),
        (12345.6, 12000.0, 12700.0, "N", "1.235e+04 N (95 %: 1.2e+04 to 1.27e+04)"),
        (0.7963, 1e-6, 1e9, "m/s²", "0.7963 m/s² (not limited by these data)"),
        (3.0, 7e-15, 22.4, "s", "3 s (at most 22.4)"),
    ],
)
def test_a_value_is_written_as_exactly_as_it_is_known(value, low, high, unit, text):
    assert interval_text(value, low, high, unit) == text


@pytest.mark.slow
@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_page_is_self_contained_and_of_modest_size(pages, verdict):
    self_contained(pages[verdict])
    assert len(pages[verdict].encode()) < 1_500_000
    assert f"{verdict}: " in pages[verdict]


@pytest.mark.slow
def test_a_page_shows_the_residual_against_every_input_and_state_and_time(pages):
    for part in ("along", "across", "theta"):
        for variable in ("v", "w", "x", "y", "theta", "time"):
            assert f'aria-label="residual of {part} against {variable}"' in pages["traced"]
        assert f'aria-label="residual of {part} over time"' in pages["traced"]
        assert f'aria-label="autocorrelation of the residual of {part}"' in pages["traced"]
    for said in ("worst of all rollouts before", "worst of all rollouts after", "a usual one"):
        for state in ("x", "y", "theta"):
            assert f"rollouts of {state} against measurement, {said}" in pages["traced"]
    assert "gain: 0." in pages["traced"]
    assert "input_gain on w</span>" in pages["traced"]


@pytest.mark.slow
def test_a_page_shows_the_shape_of_what_is_left_and_lends_it_no_name(pages):
    page = pages["unexplained"]
    assert re.search(r'aria-label="what is left of \w+ against theta"', page)
    assert "it has no name" in page
    assert "What is left, and what it depends on" not in pages["traced"]


@pytest.mark.slow
def test_what_hardly_shows_in_single_steps_is_drawn_against_what_it_depends_on_all_the_same(results):
    """Held-out steps are few: what was told by rollouts, or by what was fitted, need not stand out in them."""
    page = trace_page(replace(results["unexplained"], depends_on=("w*v",)))
    assert "hardly stands out of the noise" not in page
    even = replace(results["none"], verdict="unexplained", depends_on=("v", "constant"))
    page = trace_page(even)
    assert "hardly stands out of the noise" in page
    assert re.search(r'aria-label="what is left of \w+ against v"', page)
    assert "mean of what is left, a step" in page


@pytest.mark.slow
@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_page_says_what_a_residual_follows_only_where_there_is_more_than_noise(results, pages, verdict):
    told = re.findall(r"<h3>Residual (?:of )?([^<]*)</h3><p class=.?soft.?>[^<]*of what is not noise", pages[verdict])
    beyond = [part.said for part in loud(results[verdict])] if verdict not in {"none", "sensor_fault"} else []
    assert set(told) <= set(beyond)
    assert bool(told) == (verdict not in {"none", "sensor_fault"})
    assert pages[verdict].count("of what is not noise") == len(told)


@pytest.mark.slow
def test_a_page_says_nothing_of_what_goes_along_with_a_residual_within_the_noise(results):
    one_step, end = results["traced"].floor
    for quiet in (replace(results["traced"], floor=(10.0 * one_step, end)), replace(results["traced"], verdict="sensor_fault")):
        assert "of what is not noise" not in trace_page(quiet)


@pytest.mark.slow
def test_the_same_time_stands_at_the_same_place_in_residuals_over_time(pages):
    figures = re.findall(r'<svg role="img" aria-label="residual of \w+ over time".*?</svg>', pages["traced"], re.DOTALL)
    axes = [re.findall(r"[ML] (\S+) (\S+)", re.findall(r'<path d="([^"]*)"', figure)[1]) for figure in figures]  # after the paper
    assert len(axes) == 3
    assert axes[0] == axes[1] == axes[2]
    left, right = min(float(x) for x, _ in axes[0]), max(float(x) for x, _ in axes[0])
    assert (left, right) == pytest.approx((0.085 * 756.0, 0.99 * 756.0))


@pytest.mark.slow
def test_a_page_of_a_name_that_leaves_something_says_that_it_explains_a_part(results):
    for left, said in (
        ((), "the residual is explained by the effects below"),
        (("time",), "the effects below explain a part of the residual"),
    ):
        page = Page("", "")
        add_trace(page, {**results["traced"].to_json(), "depends_on": [*left]})
        assert f"traced: {said}." in page.html()


@pytest.mark.slow
def test_a_page_marks_the_faults_on_the_time_axis(pages):
    figure = re.search(r'<svg role="img" aria-label="residual of along over time".*?</svg>', pages["sensor_fault"], re.DOTALL)
    assert figure is not None
    assert ">offset_jump</text>" in figure.group()
    assert "var(--bad)" in figure.group()
    assert "offset_jump</text>" not in pages["traced"]


@pytest.mark.slow
def test_words_on_axes_keep_their_digits_and_colours_follow_the_window(pages):
    """Coordinates are shortened, numbers that a person reads are not."""
    fig, (ax,) = plots.figure()
    ax.plot([0.0, 1.0], [0.0, 1.0], color=plots.BLUE)
    ax.set_title("0.12345")
    drawn = plots.svg(fig, "a figure")
    assert ">0.12345</text>" in drawn
    assert re.search(r'd="M \d+\.\d{1,2} ', drawn)
    assert plots.BLUE not in drawn
    assert "var(--blue)" in drawn
    assert "prefers-color-scheme:dark" in pages["none"]


@pytest.mark.slow
def test_the_worst_rollout_is_shown(results):
    r = results["traced"]
    worst = stretches(r)[0]
    end = int(worst.starts[worst.about]) + r.held.horizon
    off = r.nominal.difference(worst.measured[[end]], worst.before[[end]])[0]
    floor = r.floor[1]
    assert np.sum((off / floor) ** 2) == pytest.approx(np.max(np.sum((r.before.ends / floor) ** 2, axis=1)))


def test_thinning_keeps_the_extremes():
    rng = np.random.default_rng(1)
    e = rng.normal(size=50_000)
    e[[17, 40_000]] = 30.0, -40.0
    assert {17, 40_000} <= set(envelope(np.arange(50_000.0), e).tolist())
    assert {17, 40_000} <= set(spread(600, e).tolist())
    assert len(envelope(np.arange(50_000.0), e)) <= 1000
    assert len(spread(600, e)) <= 720


MEASURE = (
    "<script>document.title=[document.documentElement.scrollWidth,innerWidth,document.querySelectorAll('svg').length].join(' ')</script>"
)


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("width", [500, 1280])
def test_a_page_fits_narrow_and_wide_windows(pages, verdict, width, tmp_path):
    """Chromium does not open windows under 500 pixels. Only tables and broad figures scroll, inside the page."""
    path = tmp_path / "page.html"
    path.write_text(pages[verdict].replace("</body>", f"{MEASURE}</body>"), encoding="utf-8")
    dom = rendered(path, tmp_path, f"--window-size={width},900")
    found = re.search(r"<title>(\d+) (\d+) (\d+)</title>", dom)
    assert found is not None
    needed, there, figures = map(int, found.groups())
    assert needed <= there
    assert figures == pages[verdict].count("<svg ")
    assert figures >= 25


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("differential_drive", "bicycle", "double_integrator")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["joint", *SLOW])
def test_other_models_have_their_page_too(name):
    dt, bounds, noise = {
        "differential_drive": (0.05, [(-6.0, 6.0), (-6.0, 6.0)], [0.002, 0.002, 0.004, 0.03, 0.03]),
        "bicycle": (0.025, [(-0.4, 0.4), (0.0, 2.0)], [0.003, 0.003, 0.004, 0.02]),
        "double_integrator": (0.1, [(-1.0, 1.0), (-1.0, 1.0)], [0.003, 0.003, 0.005, 0.005]),
        "joint": (0.01, [(-20.0, 20.0)], [0.0005, 0.005]),
    }[name]
    posed = name in {"differential_drive", "bicycle"}
    model = compose(ModelSpec(name, dt, GEOMETRY.get(name, {}), ARCS if posed else ()))
    rng = np.random.default_rng(7)
    u = commands(rng, 1, 500, dt, bounds, hold=(10 * dt, 32 * dt))
    last = model.inputs[-1]
    y = drive(rng, name, u, [("input_gain", last, {"gain": 0.8})], dt, np.array(noise))
    result = trace(from_arrays(model, [(y[0], u[0])]), model)
    page = trace_page(result)
    self_contained(page)
    assert len(page.encode()) < 2_000_000
    for state in model.states:
        assert f"rollouts of {state} against measurement" in page
    for variable in (*model.inputs, *model.states, "time"):
        assert f"residual of {'along' if posed else model.states[-1]} against {variable}" in page
    assert max(len(line) for line in result.text().splitlines()) <= 100


@pytest.mark.slow
def test_a_suggested_drive_stands_on_the_page(results):
    drive_next = suggest(results["ambiguous"], duration=4.0)
    page = trace_page(results["ambiguous"], drive_next)
    assert "What to drive next" in page
    assert "nats between" in page
    assert 'aria-label="suggested w over time"' in page


@pytest.mark.slow
def test_a_page_of_a_hundred_thousand_rows_stays_a_page():
    rng = np.random.default_rng(3)
    u = commands(rng, 1, 100_000, DT, BOUNDS)
    y = drive(rng, "unicycle", u, [("input_gain", "w", {"gain": 0.8})], DT, NOISE)
    y[0, 60_000:, 1] += 2.0
    page = trace_page(trace(from_arrays(UNICYCLE, [(y[0], u[0])]), UNICYCLE))
    assert len(page.encode()) < 2_000_000


@pytest.mark.parametrize(("gain", "unit"), [(0.2777, "km/h"), (0.1047, "rpm"), (0.01745, "degrees"), (0.29, ""), (1.0, "")])
def test_a_gain_that_is_just_that_of_a_unit_is_asked_about(gain, unit):
    words = in_words("input_gain", "v", {"gain": gain})
    assert words.startswith(f"v does {100.0 * gain:.3g} % of what is commanded")
    assert words.endswith(f"(is it commanded in {unit}?)" if unit else "commanded")


@pytest.mark.slow
def test_the_account_says_which_numbers_of_the_model_nobody_said(results, tmp_path):
    def of(**parameters):
        return _assumed(replace(results["none"], nominal=compose(ModelSpec("differential_drive", 0.05, parameters))))

    assert of() == ["default parameters of the model: wheel_radius = 0.1, track = 0.5 (--param wheel_radius=... for another value)"]
    assert of(wheel_radius=0.1) == ["default parameters of the model: track = 0.5 (--param track=... for another value)"]
    assert of(wheel_radius=0.1, track=0.5) == []
    assert _assumed(results["none"]) == []  # a unicycle has none
    (tmp_path / "own.py").write_text(
        "STATES, INPUTS, PARAMS = ('x',), ('u',), {'k': 2.0}\n\n\ndef step(x, u, dt, p):\n    return x + p['k'] * dt * u\n"
    )
    assert _assumed(replace(results["none"], nominal=compose(ModelSpec(str(tmp_path / "own.py"), 0.05)))) == []  # who wrote it has said
