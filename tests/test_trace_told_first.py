"""Of several things that what is left may depend on, the one that explains most is told first."""

import pytest

from s2r_runtime.trace import whole
from s2r_runtime.trace.answer import _in_order
from s2r_runtime.trace.challenge import Better
from s2r_runtime.trace.lack_of_fit import Structure


def test_what_is_left_comes_first_where_no_name_is_given():
    left = Structure(("memory(w)",), True, 1.0, {}, beside=("time*w",))
    assert _in_order(left, "unexplained") == ("memory(w)", "time*w")
    noise = Structure(("noise",), False, 0.0, {}, beside=("time*w",))
    assert _in_order(noise, "traced") == _in_order(noise, "unexplained") == ("time*w", "noise")


@pytest.mark.parametrize(("nats", "first"), [(580.0, "time*v"), (5.0, "memory(v)")])
def test_of_a_field_and_a_shape_the_one_that_explains_more_comes_first(nats, first, monkeypatch):
    left = Structure(("time*v",), True, 1.0, {}, varies=True, nats=nats)
    monkeypatch.setattr(whole, "lack_of_fit", lambda *of: left)
    asked = whole.Whole.__new__(whole.Whole)
    asked.__dict__.update(_looks=None, nominal=None, _horizon=1, _shape=Better("memory(v)", 17.0))
    assert asked._of_nominal().tokens[0] == first
