"""What happens in a log, in the words of the daemon's console."""

from __future__ import annotations

from typing import get_args

from s2r_runtime import messages as m
from s2r_runtime.core import reducer
from s2r_runtime.daemon.console import Console
from s2r_runtime.messages import Struct

_EVENTS, _OUTPUTS = get_args(m.Event), get_args(m.Output)
BAD = (m.AlarmRaised, m.Revoked, m.OverrideChanged)
"""What is an error in a list of words, not a notice."""


class Words:
    """`take` every message, in the order of the log."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._console = Console(self._lines.append)
        self._state = reducer.initial()

    def take(self, message: Struct) -> list[str]:
        """What it says to a person: mostly nothing."""
        self._lines.clear()
        if isinstance(message, m.StartCampaign):
            goes = "goes on" if message.resume else "begins"
            self._lines.append(f"campaign of epoch {message.epoch} {goes}: {message.n} samples")
        elif isinstance(message, _EVENTS):
            self._console.happened(message)
        elif isinstance(message, _OUTPUTS):
            self._console.decided((message,), self._state)
        return list(self._lines)
