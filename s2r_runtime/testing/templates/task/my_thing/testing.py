"""How the task is tried."""

from my_thing.task import MyThing
from s2r_runtime.testing import TaskKit


class MyThingKit(TaskKit):
    """On every model that has the states x, y."""

    task = MyThing
