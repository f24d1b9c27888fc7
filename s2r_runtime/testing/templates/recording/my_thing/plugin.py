"""What this package offers: nothing is imported before it is used."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl

S2R_API_VERSION = 1


@hookimpl
def s2r_recordings() -> list[Offer]:
    """TRANSPORT.SUFFIX: files that end with .my_thing; with a profile of the transport my_thing, its options are the reader's."""
    return [Offer("my_thing.my_thing", "my_thing.logs:read", "logs of one reading a line")]
