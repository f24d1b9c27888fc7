"""What can go wrong for a reason that a person can mend: one tree, one exit code a kind.

Every message says what is wrong, where, and what would be right, on one line.
"""

from __future__ import annotations


class S2RError(Exception):
    """Base of all errors that are reported as one line. `exit_code` is the process's."""

    exit_code = 70


class UsageError(S2RError):
    """The call was wrong: an unknown option, a missing file, a recording that cannot be read as named."""

    exit_code = 2


class RecordingError(UsageError):
    """A recording (CSV or MCAP) does not hold what was asked of it, or holds it wrongly."""


class MissingSignal(RecordingError):
    """A recording lacks a topic or message that a reader looks for by default; another one in it may do."""


class NotEnoughEvidence(S2RError):
    """The data do not carry the statement. `missing`: how many more independent samples would (0: not a matter of number). `also`: what
    `--json` tells besides.
    """

    exit_code = 3

    def __init__(self, message: str, missing: int = 0) -> None:
        super().__init__(message)
        self.missing = missing
        self.also: dict[str, object] = {}


class ConfigError(S2RError):
    """A profile, model, key, certificate or state file is not valid, or belongs to something else."""

    exit_code = 78


class PluginError(ConfigError):
    """A plug-in is missing, cannot be loaded, or takes a name that is already taken."""


class ControllerError(S2RError):
    """A controller raised, hung, died, or returned something that is not a finite input of the right shape."""

    exit_code = 1


def one_line(text: str, length: int = 300) -> str:
    """Somebody else's text for use in a message: on one line, printable, at most `length` characters."""
    flat = " ".join("".join(c if c.isprintable() else " " for c in text[: 4 * length]).split())
    return flat if len(flat) <= length else flat[: length - 3] + "..."
