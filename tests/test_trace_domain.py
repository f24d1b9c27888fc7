"""Where a repair was fitted and judged is told with it: it need not hold elsewhere."""

import math
from dataclasses import replace

import numpy as np
import pytest
from trace_robots import declared, recordings

from s2r_runtime.models.composed import AppliedEffect
from s2r_runtime.modelspec import dump_model, parse_model
from s2r_runtime.plugins import registry
from s2r_runtime.report.trace_page import trace_page
from s2r_runtime.trace.diagnostics.validity_domain import ALL_ROUND, BEYOND, Range, _arc, _span, domain_of, told
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.pipeline import trace

GAIN = [("input_gain", "w", {"gain": 0.75})]


def _within(angles, low, high):
    return np.remainder(angles - low + 1e-9, math.tau) <= high - low + 2e-9


@pytest.mark.parametrize("about", [0.0, 1.5, 3.1, -3.1])
@pytest.mark.parametrize("wide", [0.01, 1.0, 2.5])
def test_an_arc_is_the_shortest_one_that_holds_nearly_all(about, wide):
    """Against every arc that begins at one angle and ends at another."""
    rng = np.random.default_rng([int(100 * wide), int(10 * abs(about))])
    angles = np.concatenate([about + wide * rng.uniform(-1.0, 1.0, 198), rng.uniform(-math.pi, math.pi, 2)])
    low, high = _arc(np.remainder(angles + math.pi, math.tau) - math.pi)
    held = math.ceil((1.0 - BEYOND) * 200)
    lengths = [length for a in angles for length in [np.sort(np.remainder(angles - a, math.tau))[held - 1]]]
    assert high - low == pytest.approx(min(lengths))
    assert np.sum(_within(angles, low, high)) >= held
    assert -math.pi <= low <= math.pi


def test_an_arc_that_leaves_out_next_to_nothing_goes_all_round():
    assert _arc(np.linspace(0.0, math.tau - 0.5 * ALL_ROUND, 2000)) == (None, None)
    low, high = _arc(np.linspace(0.0, math.tau - 1.2 * ALL_ROUND, 2000))
    assert high - low < math.tau - ALL_ROUND


def test_few_wild_values_do_not_widen_a_range():
    values = np.concatenate([np.linspace(0.0, 1.0, 996), [90.0, -70.0, 1e9, math.pi]])
    low, high = _span(values)
    assert -0.01 < low < 0.01
    assert 0.99 < high < 1.01


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (-0.000709, 1.0912, "x from 0 to 1.09 m"),
        (1234.5678, 1234.6789, "x from 1234.568 to 1234.679 m"),
        (0.3, 0.3, "x 0.3 m only"),
        (0.0, 0.0, "x 0 m only"),
        (90.0, 1200.0, "x from 90 to 1200 m"),
        (-2.5e-4, 1.5e-4, "x from -0.00025 to 0.00015 m"),
        (None, None, "x all round"),
    ],
)
def test_a_range_in_words(low, high, said):
    assert Range("x", low, high, "m").text() == said


@pytest.mark.slow
def test_what_was_found_says_where():
    """On the page, in the account, in the model's file and in JSON; of all that was fitted and judged."""
    (data,) = recordings(GAIN, 1, steps=700, seed=45)
    found = trace(data, declared())
    assert [e.name for e in found.effects] == ["input_gain"]
    y, u = data.runs[0].y, data.runs[0].u
    ranges = {one.name: one for one in found.domain}
    assert [*ranges] == [*data.states, *data.inputs]
    for i, name in enumerate(data.inputs):
        assert np.min(u[:, i]) - 1e-9 <= ranges[name].low < ranges[name].high <= np.max(u[:, i]) + 1e-9
    for i, name in enumerate(("x", "y")):
        assert np.mean((y[:, i] < ranges[name].low) | (y[:, i] > ranges[name].high)) <= 1.5 * BEYOND
    line = f"range of validity: {told(found.domain)}; untested outside"
    assert line in " ".join(found.text().split())
    assert line in trace_page(found)
    within = found.to_json()["seen_within"]
    assert within["v"] == {"low": ranges["v"].low, "high": ranges["v"].high, "unit": "m/s"}
    text = dump_model(found.spec, found.comments())
    assert f"# Fitted or judged where {told(found.domain)}\n" in text
    assert parse_model(text, ".", "m").digest() == found.spec.digest()


def test_inputs_are_told_as_they_were_asked():
    """Not as they act after what the model has of them."""
    model = declared()
    gain = AppliedEffect(registry().get("effects", "input_gain"), "w", {"gain": 0.5})
    (data,) = recordings([], 1, steps=300, seed=46)
    given = data, steps_of(data)
    assert domain_of(replace(model, effects=(*model.effects, gain)), given) == domain_of(model, given)


@pytest.mark.slow
def test_where_nothing_was_found_nothing_is_said_to_be_found():
    (data,) = recordings([], 1, steps=700, seed=44)
    found = trace(data, declared())
    assert found.verdict == "none"
    assert "judged where" not in found.text() + trace_page(found) + dump_model(found.spec, found.comments())
    assert {*found.to_json()["seen_within"]} == {*data.states, *data.inputs}
