"""The Zenoh transport is what the runtime relies on, with a robot that is a peer and with one that is a client."""

from __future__ import annotations

from s2r_zenoh.kits import ClientKit, PeerKit


class TestPeer(PeerKit):
    pass


class TestClient(ClientKit):
    pass
