"""How `s2r plugin check zenoh` tries the transport: with a robot that is a peer and with one that is a client."""

from __future__ import annotations

from functools import partial

from s2r_runtime.testing import TransportKit
from s2r_zenoh.testing import ZenohRig


class PeerKit(TransportKit):
    """A robot that connects to the runtime."""

    rig = ZenohRig


class ClientKit(TransportKit):
    """A robot that takes the runtime for its router."""

    rig = partial(ZenohRig, "client")
