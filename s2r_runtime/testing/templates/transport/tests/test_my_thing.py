"""The transport keeps the runtime's interface. Add what your protocol promises beyond it."""

from my_thing.testing import MyThingKit


class TestMyThing(MyThingKit):
    pass
