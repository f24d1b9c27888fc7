"""Logs of one reading a line: `12.345 x 0.102`, the time in s, what it is, its value in SI units. Lines that begin with # say nothing.

Readings of states and of inputs come each at their own time. What a line does not name was not received then: NaN.
"""

import gzip
import math

import numpy as np

from s2r_runtime.errors import ConfigError, RecordingError


def read(path, states, inputs, options):
    """[((t, x), (t, u))]: one stretch; t (N,) s, ascending, x (N, nx), u (M, nu). options: the profile's, of a transport my_thing."""
    if options:
        raise ConfigError(f"transport.{min(options)}: a log of my_thing has no options")
    rows = {states: ([], []), inputs: ([], [])}
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt", encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line.strip() or line.startswith("#"):
                continue
            t, name, value = reading(line, f"{path}: line {number}")
            for names, (times, values) in rows.items():
                if name in names:
                    times.append(t)
                    values.append([value if name == other else math.nan for other in names])
    return [tuple(ordered(*rows[names], len(names)) for names in (states, inputs))]


def reading(line, where):
    words = line.split()
    try:
        t, name, value = float(words[0]), words[1], float(words[2])
    except (ValueError, IndexError):
        raise RecordingError(f"{where}: is {line.strip()[:60]!r}, must be TIME NAME VALUE") from None
    if not (math.isfinite(t) and math.isfinite(value)):
        raise RecordingError(f"{where}: is {line.strip()[:60]!r}, must be finite")
    return t, name, value


def ordered(times, values, width):
    t, rows = np.array(times, dtype=float), np.array(values, dtype=float).reshape(-1, width)
    order = np.argsort(t, kind="stable")
    return t[order], rows[order]
