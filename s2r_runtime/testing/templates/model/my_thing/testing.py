"""How the model is tried."""

from my_thing.model import MODEL
from s2r_runtime.testing import ModelKit


class MyThingKit(ModelKit):
    """On steps of 0.05 s, states and inputs of the order of 1."""

    model = MODEL
