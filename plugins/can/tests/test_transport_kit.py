"""The CAN transport is what the runtime relies on: on CAN FD in one process, and on classic frames over a real socket."""

from __future__ import annotations

from s2r_can.testing import SocketRig, VirtualRig

from s2r_runtime.testing import TransportKit


class TestWide(TransportKit):
    rig = VirtualRig
    carries = ()


class TestClassic(TransportKit):
    rig = SocketRig
    carries = ()
    tolerance = 1e-6
