"""A small file's bytes, without waiting for a pipe, following a device that never ends, or filling the memory.

Profiles, models, keys, certificates and controllers are regular files of at most some megabytes; what is not is refused before it is read.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from s2r_runtime.errors import ConfigError
from s2r_runtime.files import limits

MB = 1 << 20


def read_bounded(path: Path, most: int | None = None) -> bytes:
    """At most `most` bytes of a regular file (None: as `limits.TEXT` is set). Raises ConfigError, one line, for anything else."""
    more = "" if most is not None else f"; {limits.TEXT.more()}"
    most = round(limits.TEXT.value()) if most is None else most
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise ConfigError(f"{path}: is a pipe or a device, must be a regular file")
            data = file.read(most + 1) if status.st_size <= most else b"\0" * (most + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # a NUL in its name
        raise ConfigError(f"{path}: is no path: {error}") from None
    if len(data) > most:
        raise ConfigError(f"{path}: has more than {most} bytes, the most that is read of such a file{more}")
    return data
