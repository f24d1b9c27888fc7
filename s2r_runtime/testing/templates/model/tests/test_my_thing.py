"""The model keeps the runtime's interface, and is the physics that it says."""

import numpy as np
import pytest
from my_thing.model import MODEL
from my_thing.testing import MyThingKit


class TestMyThing(MyThingKit):
    pass


def test_a_held_force_is_balanced_by_drag_in_the_end():
    x, u = np.zeros((1, 2)), np.array([[0.6]])
    for _ in range(2000):
        x = MODEL.step(x, u, 0.05, MODEL.parameters)
    assert x[0, 1] == pytest.approx(0.6 / 0.3)
