"""Text of a TOML file -> its tables, within bounds: profiles and models are written by hand, and sometimes by whoever wishes ill.

Python's parser raises other errors than its own for numbers of thousands of digits and for deep nesting, and takes time that grows with
the square of a dotted key's length. Here all of that is a ConfigError in one line.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from s2r_runtime.errors import ConfigError, one_line
from s2r_runtime.files import limits
from s2r_runtime.files.bounded_file import read_bounded

TEXT_MAX = 4 << 20
"""Characters, unless `limits.TEXT` is set; a model with a position field of 10 000 values has 200 kB."""
DEPTH_MAX = 32
"""Of tables and arrays; a profile has five."""
DOTS_MAX = 200
"""Between two commas, equals signs or line ends: parts of a dotted key. Their time grows with the square."""
INTEGER_MAX = 2**63


def load_toml(path: Path) -> dict[str, Any]:
    """The tables of a file. Raises ConfigError naming the file."""
    return parse_toml(read_text(path), str(path))


def read_text(path: Path) -> str:
    """A file's text. Raises ConfigError for what cannot be read, is no regular file, is too long, or is not UTF-8."""
    data = read_bounded(path)
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a text. Raises ConfigError."""
    if len(text) > limits.TEXT.value():
        raise ConfigError(f"{where}: has more than {limits.TEXT.value():.0f} characters; {limits.TEXT.more()}")
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") > DOTS_MAX and any(piece.count(".") > DOTS_MAX for piece in re.split("[,=]", line)):
            raise ConfigError(f"{where}: line {number}: has more than {DOTS_MAX} dots in a row; a dotted key has a few parts")
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{where}: not TOML: nested too deeply (at most {DEPTH_MAX} levels)") from None
    except ValueError as error:  # TOMLDecodeError is one, and so is what `int` says of 5000 digits
        raise ConfigError(f"{where}: not TOML: {one_line(str(error))}") from None
    _check(table, where, 0)
    return table


def _check(value: Any, where: str, depth: int) -> None:
    """Raises ConfigError for what no setting can hold. (TOML itself has no integers beyond 64 bits.)"""
    if depth > DEPTH_MAX:
        raise ConfigError(f"{where}: nested too deeply (at most {DEPTH_MAX} levels)")
    if isinstance(value, dict):
        for key, item in value.items():
            _check(key, where, depth)
            _check(item, where, depth + 1)
    elif isinstance(value, list):
        for item in value:
            _check(item, where, depth + 1)
    elif isinstance(value, int) and not -INTEGER_MAX <= value < INTEGER_MAX:
        raise ConfigError(f"{where}: holds a whole number of more than 64 bits")
    elif isinstance(value, str) and "\0" in value:
        raise ConfigError(f"{where}: holds a text with a NUL character: {one_line(value, 60)!r}")
