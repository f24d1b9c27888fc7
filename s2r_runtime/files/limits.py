"""Limits of what is read of a file that somebody hands over, and the environment variables that set them (docs/recordings.md).

They are read where a file is. Errors name the variable. A log is written, and the control socket served, within constants.
"""

from __future__ import annotations

import os
from typing import NamedTuple

from s2r_runtime.errors import ConfigError

MB, GB = 1 << 20, 1_000_000_000


class Limit(NamedTuple):
    """default: in `unit` bytes (or ones)."""

    name: str
    default: float
    unit: int
    what: str

    def value(self) -> float:
        """What holds now, in bytes (or ones). Raises ConfigError for a setting that is no number > 0."""
        text = os.environ.get(self.name, "")
        try:
            number = float(text) if text else self.default
        except ValueError:
            number = 0.0
        if not 0.0 < number < float("inf"):
            raise ConfigError(f"{self.name} is {text!r} in the environment, must be a number > 0")
        return number * self.unit

    def more(self) -> str:
        """How to read more, for an error."""
        return f"to read more, set {self.name} in the environment (now {self.value() / self.unit:g})"


TEXT = Limit("S2R_MAX_TEXT_MB", 4.0, MB, "a profile, model, controller: MB")
FILE = Limit("S2R_MAX_FILE_GB", 4.0, GB, "a recording in a format that is read at once: GB")
NUMBERS = Limit("S2R_MAX_NUMBERS", 200e6, 1, "numbers that such a recording holds, or that are read of it")
RATIO = Limit("S2R_MAX_RATIO", 100.0, 1, "size of these numbers, over that of the file that packs them")
ATTACHED = Limit("S2R_MAX_ATTACHED_MB", 64.0, MB, "attachments between two chunks of a log: MB")
ALL = (TEXT, FILE, NUMBERS, RATIO, ATTACHED)
