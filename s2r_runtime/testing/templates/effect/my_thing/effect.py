"""An input acts more than in proportion: u_act = u + bend u^3."""

import numpy as np

from s2r_runtime.hookspecs import Parameter


class MyThing:
    """On any input of any model. It remembers nothing."""

    name = "my_thing"
    stage = "input"
    parameters = (Parameter("bend", "1/input²", -100.0, 100.0, neutral=0.0),)
    side_by_side = True

    def channels(self, model):
        return model.inputs

    def unit(self, model, channel, parameter):
        return f"1/({getattr(model, 'units', {}).get(channel, 'input')})²"

    def hidden(self, n, model, channel, dt, p):
        return np.zeros((n, 0))

    def input_step(self, u, z, model, channel, dt, p):
        return self.input_sequence(u, model, channel, dt, p), z

    def input_sequence(self, u, model, channel, dt, p):
        acting = u.copy()
        acting[..., model.inputs.index(channel)] += p["bend"] * u[..., model.inputs.index(channel)] ** 3
        return acting

    def after_step(self, x, u, x_next, model, channel, dt, p):
        return x_next  # it acts on inputs only


EFFECT = MyThing()
