"""The task keeps the runtime's interface, and its metric says what it is meant to."""

import numpy as np
import pytest
from my_thing.task import MyThing
from my_thing.testing import MyThingKit

from s2r_runtime.plugins import registry


class TestMyThing(MyThingKit):
    pass


def test_a_wall_that_was_touched_is_a_negative_value():
    task = MyThing({}, registry().get("models", "unicycle"), 0.05)
    scenario = {"start": np.zeros((2, 3))}
    tally = task.begin(scenario)
    for y in (0.0, 0.45, 0.0):
        tally = task.observe(tally, np.array([[0.1, y, 0.0], [0.1, 0.0, 0.0]]), scenario)
    assert task.safety(tally).tolist() == pytest.approx([-0.05, 0.4])
