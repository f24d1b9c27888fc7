"""A run for reports."""

from __future__ import annotations

from core_rig import Rig

from s2r_runtime.messages import Event, Output


class Answered(Rig):
    """A rig that keeps events and outputs in the log's order."""

    log: list[Event | Output]

    def feed(self, event: Event) -> list[Output]:
        outputs = super().feed(event)
        self.log = [*getattr(self, "log", []), event, *outputs]
        return outputs
