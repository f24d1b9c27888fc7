"""The effect is what it claims to be."""

import numpy as np
from my_thing.effect import EFFECT
from my_thing.testing import MyThingKit

from s2r_runtime.plugins import registry


class TestMyThing(MyThingKit):
    pass


def test_it_bends_one_input_and_leaves_the_other():
    model = registry().get("models", "unicycle")
    acting = EFFECT.input_sequence(np.array([[2.0, 2.0]]), model, "w", 0.1, {"bend": 0.5})
    assert acting.tolist() == [[2.0, 6.0]]
