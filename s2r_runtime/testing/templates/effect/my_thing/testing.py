"""How the effect is tried: at values at which it does something."""

from my_thing.effect import EFFECT
from s2r_runtime.testing import EffectKit


class MyThingKit(EffectKit):
    """On every channel of every model."""

    effect, parameters = EFFECT, {"bend": 0.02}
