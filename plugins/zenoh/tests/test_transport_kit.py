"""The Zenoh transport is what the runtime relies on, with a robot that is a peer and with one that is a client."""

from __future__ import annotations

from functools import partial

from s2r_zenoh.testing import ZenohRig

from s2r_runtime.testing import TransportKit


class TestPeer(TransportKit):
    rig = ZenohRig


class TestClient(TransportKit):
    rig = partial(ZenohRig, "client")
