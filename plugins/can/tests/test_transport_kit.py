"""The CAN transport is what the runtime relies on: on CAN FD in one process, and on classic frames over a real socket."""

from __future__ import annotations

from s2r_can.kits import ClassicKit, WideKit


class TestWide(WideKit):
    pass


class TestClassic(ClassicKit):
    pass
