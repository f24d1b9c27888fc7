"""Messages as they are read in Python: an option is `dt=...` there, and `--dt ...` on the command line."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from s2r_runtime.errors import S2RError

P = ParamSpec("P")
R = TypeVar("R")

_SHORT = {"-n": "n", "-o": "output"}
_PAIR = re.compile(r"(?<![\w-])--(column|state|input|param|weight) ([^\s=,;:()]+)=([^\s,;:()]+)")
_VALUE = re.compile(r"(?<![\w-])(--[a-z][a-z-]*|-n|-o) (?=[A-Z][A-Z0-9]*\b(?![a-z]))")
_OPTION = re.compile(r"(?<![\w-])(--[a-z][a-z-]*|-n(?= |:)|-o(?= |:))")


def in_python(message: str) -> str:
    """A message with its options as keywords: `--column x=COLUMN` becomes `column={'x': 'COLUMN'}`, `--dt DT` becomes `dt=DT`."""
    message = _PAIR.sub(_pair, message)
    message = _VALUE.sub(lambda found: f"{_keyword(found[1])}=", message)
    return _OPTION.sub(lambda found: _keyword(found[1]), message)


def front_door(function: Callable[P, R]) -> Callable[P, R]:
    """A public function, whose errors name options as keywords."""

    @functools.wraps(function)
    def called(*args: P.args, **options: P.kwargs) -> R:
        try:
            return function(*args, **options)
        except S2RError as error:
            if error.args and isinstance(error.args[0], str):
                error.args = (in_python(error.args[0]), *error.args[1:])
            raise

    return called


def _pair(found: re.Match[str]) -> str:
    """A dict with one entry; the values of `weight` and `param` are numbers."""
    option, name, value = found.groups()
    return f"{option}={{{name!r}: {value if option in {'weight', 'param'} else repr(value)}}}"


def _keyword(option: str) -> str:
    return _SHORT.get(option) or option.removeprefix("--").replace("-", "_")
