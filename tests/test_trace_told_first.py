"""Of several things that what is left may depend on, the one that explains most is told first."""

from types import SimpleNamespace

import numpy as np
import pytest
from seeds import first
from trace_robots import declared, recordings

from s2r_runtime.trace.assemble import _in_order
from s2r_runtime.trace.diagnostics import whole_recording
from s2r_runtime.trace.diagnostics.lack_of_fit import Structure
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.unnamed_alternatives import Better


def test_what_is_left_comes_first_where_no_name_is_given():
    left = Structure(("memory(w)",), True, 1.0, {}, beside=("time*w",))
    assert _in_order(left, "unexplained") == ("memory(w)", "time*w")
    noise = Structure(("noise",), False, 0.0, {}, beside=("time*w",))
    assert _in_order(noise, "traced") == _in_order(noise, "unexplained") == ("time*w", "noise")


@pytest.mark.parametrize(("nats", "first"), [(580.0, "time*v"), (5.0, "memory(v)")])
def test_of_a_field_and_a_shape_the_one_that_explains_more_comes_first(nats, first, monkeypatch):
    left = Structure(("time*v",), True, 1.0, {}, varies=True, nats=nats)
    monkeypatch.setattr(whole_recording, "lack_of_fit", lambda *of: left)
    asked = whole_recording.Whole.__new__(whole_recording.Whole)
    asked.__dict__.update(_looks=None, nominal=None, _horizon=1, _shape=Better("memory(v)", 17.0))
    assert asked._of_nominal().tokens[0] == first


def _likened(weighed, unnamed, shape=None, field=None):
    """What is told of a dictionary that is likeliest, of one that foretells other blocks of time best, of a shape and a field."""
    asked = whole_recording.Whole.__new__(whole_recording.Whole)
    looks = SimpleNamespace(weighed=dict(weighed), field=field, chosen=([], {}), left=None)
    given = SimpleNamespace(floor=SimpleNamespace(axes=()))
    asked.__dict__.update(_looks=looks, given=given, unnamed=SimpleNamespace(token=unnamed[0], gain=unnamed[1]), _shape=shape)
    return asked._looks_like


def _field(*tokens, nats):
    return SimpleNamespace(tokens=tokens, nats=nats)


def test_a_place_that_was_visited_once_is_told_though_nothing_foretells_it():
    """Dictionaries and fields are weighed alike; by what they foretell only where noise of some colour does nearly as well."""
    assert _likened({"v*w": 214.0}, ("position", 40.0), field=_field("time*w", nats=140.0)) == ("v*w",)
    assert _likened({"v*w": 214.0}, ("position", 40.0), field=_field("time*w", nats=240.0)) == ("time*w",)
    assert _likened({"heading": 2.0}, ("position", 40.0), field=_field("time*w", nats=45.0)) == ("position",)
    assert _likened({"heading": 2.0}, ("position", 40.0), field=_field("time*w", nats=55.0)) == ("time*w",)


def test_of_fields_that_do_alike_the_one_of_the_likeliest_dictionary_comes_first():
    assert _likened({"position": 45.0}, ("w", 9.0), field=_field("time*v", "position", nats=61.0)) == ("position", "time*v")


def test_what_foretells_best_is_told_beside_what_is_likeliest():
    """If it is half as likely at least. Dictionaries that are as likely are told together."""
    assert _likened({"force": 233.0, "speed": 204.0}, ("speed", 359.0)) == ("force", "speed")
    assert _likened({"v": 73.0, "w": 4.0}, ("w", 78.0)) == ("v",)
    assert _likened({"memory(w)": 44.9, "time*w": 44.8, "w": 18.0}, ("w", 9.0)) == ("memory(w)", "time*w")


def test_a_shape_is_told_where_it_is_clearly_likelier():
    assert _likened({"w": 30.0}, ("w", 9.0), shape=Better("memory(w)", 50.0)) == ("memory(w)",)
    assert _likened({"w": 48.0}, ("w", 9.0), shape=Better("memory(w)", 50.0)) == ("w",)


@pytest.mark.parametrize("seed", first(1, range(4)))
def test_a_turn_by_speed_and_turning_is_not_taken_for_a_drift(seed):
    """It yaws more by a share of v |w|: as places, headings and times go with the inputs, each explains some of it."""

    def outside(x, v, w):
        return v, w + 1.2 * v * np.abs(w), 0.0 * v, 0.0 * v

    (data,) = recordings([], 1, steps=700, seed=70 + seed, outside=outside)
    found = trace(data, declared())
    assert found.depends_on[0] in {"v*w", "v", "w"}
