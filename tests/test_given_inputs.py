"""Given inputs are driven exactly as they are written, or not at all."""

from __future__ import annotations

from typing import Any

import pytest

from s2r_runtime.daemon.given_inputs import ROWS_MAX, parse_inputs
from s2r_runtime.errors import ConfigError

BOUNDS = {"v": (-0.2, 0.2), "w": (-3.0, 3.0)}


def parsed(text: str, columns: dict[str, str] | None = None) -> Any:
    return parse_inputs(text.encode(), "inputs.csv", ("v", "w"), BOUNDS, 0.1, columns or {})


def test_given_inputs_are_read_as_they_are_written() -> None:
    assert parsed("t,v,w\n5.0,0.1,1\n5.1,-0.2,-3\n").rows == ((0.1, 1.0), (-0.2, -3.0))
    assert parsed("\ufeffw,t,v\r\n1,0.000,0.1\r\n\r\n2,0.1001,0\r\n").rows == ((0.1, 1.0), (0.0, 2.0))
    assert parsed("t,speed,w\n0,0.1,1\n", {"v": "speed"}).rows == ((0.1, 1.0),)
    one, other = parsed("t,v,w\n0,0,0\n"), parsed("t,v,w\n0,0,0.0\n")
    assert one.rows == other.rows
    assert one.digest != other.digest, "of the bytes"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("t,v,w\n", "has 0 rows"),
        ("t,v\n0,0\n", "lacks the column 'w'"),
        ("v,w\n0,0\n", "lacks the column 't'"),
        ("t,v,w,x\n0,0,0,0\n", "column 'x' that is no input"),
        ("t,v,v,w\n0,0,0,0\n", "column 'v' is there 2 times"),
        ("t,v,w\n0,0\n", "line 2: has 2 cells, the header has 3"),
        ("t,v,w\n0,0,\n", "line 2: w is blank, must be a number"),
        ("t,v,w\n0,0,nan\n", "line 2: w is nan, must be a number"),
        ("t,v,w\n0,0,one\n", "line 2: w is one, must be a number"),
        ("t,v,w\n0,0,0\n0.1,0.3,0\n", "line 3 (t 0.1 s): v is 0.3, must be within its bounds -0.2 to 0.2"),
        ("t,v,w\n0,0,0\n0.1,0,-3.0001\n", "w is -3.0001, must be within its bounds"),
        ("t,v,w\n0,0,0\n0.2,0,0\n", "line 3: t is 0.2 s, must be 0.1 s: one row a period of the model, 0.1 s"),
        ('t,v,w\n0,0,"0\n', "not CSV"),
        ("t,v,w\n" + "0,0,0\n" * (ROWS_MAX + 1), f"must have 1 to {ROWS_MAX}"),
    ],
)
def test_what_is_wrong_with_given_inputs_is_said_on_one_line(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parsed(text)
    message = str(caught.value)
    assert message.startswith("inputs.csv: ")
    assert said in message
    assert "\n" not in message


def test_bytes_that_are_no_text_are_refused() -> None:
    with pytest.raises(ConfigError, match="is not UTF-8 text"):
        parse_inputs(b"\xff\xfe", "inputs.csv", ("v",), {"v": (-1.0, 1.0)}, 0.1, {})
    with pytest.raises(ConfigError, match="bytes, must have at most"):
        parse_inputs(b" " * (9 << 20), "inputs.csv", ("v",), {"v": (-1.0, 1.0)}, 0.1, {})
