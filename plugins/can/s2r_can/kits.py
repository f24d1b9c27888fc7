"""How `s2r plugin check can` tries the transport: on CAN FD in one process, and on classic frames over a real socket."""

from __future__ import annotations

from s2r_can.testing import SocketRig, VirtualRig
from s2r_runtime.testing import TransportKit


class WideKit(TransportKit):
    """64-bit floats in FD frames. A command has its counter and checksum, and the robot its own time-out."""

    rig = VirtualRig
    carries = ()


class ClassicKit(TransportKit):
    """Eight bytes a frame, scaled."""

    rig = SocketRig
    carries = ()
    tolerance = 1e-6
