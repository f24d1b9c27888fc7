"""The bit extraction is cantools', bit for bit: on random frames of random DBCs, both ways."""

from __future__ import annotations

import importlib.util
import math
import random
from pathlib import Path
from typing import Any

import cantools
import pytest
from s2r_can.bits import Part, reader, selected, selectors_of
from s2r_can.database import Database, Named
from s2r_can.layout import scaled
from s2r_can.options import Source
from s2r_can.records import records
from s2r_can.transport import CanTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command

SPEC = importlib.util.spec_from_file_location("random_dbc", Path(__file__).with_name("random_dbc.py"))
assert SPEC is not None
assert SPEC.loader is not None
random_dbc = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(random_dbc)

DATABASES, FRAMES = 60, 60


def same(a: float, b: float) -> bool:
    return a == b or (math.isnan(a) and math.isnan(b))


def payloads(draw: random.Random, length: int, count: int) -> list[bytes]:
    """Random bytes, and all ones and zeros."""
    return [b"\0" * length, b"\xff" * length, *(draw.randbytes(length) for _ in range(count - 2))]


@pytest.mark.parametrize("block", range(3))
def test_every_signal_of_random_frames_is_what_cantools_says(block: int) -> None:
    draw = random.Random(block)
    compared = absent = nested = 0
    for seed in range(block * DATABASES, (block + 1) * DATABASES):
        text = random_dbc.Dbc(seed).text
        reference: Any = cantools.database.load_string(text, database_format="dbc")
        database = Database({"file": "random.dbc", "text": text})
        for message in reference.messages:
            ours = []
            for signal in message.signals:
                named = database.signal(f"{message.name}.{signal.name}", "test")
                s = scaled(named, Source("", 1.0), "test")._replace(low=-math.inf, high=math.inf)
                selectors = selectors_of(named.message, named.signal, "test")
                nested += len(selectors) > 1
                ours.append((signal.name, s.bits, selectors, reader(Part(selectors, (s,), (0,)))))
            for payload in payloads(draw, message.length, FRAMES):
                try:
                    told = message.decode(payload, decode_choices=False)
                except cantools.database.DecodeError:  # a multiplexer's value that the DBC does not know: cantools gives up on all of it
                    told = None
                little, big = int.from_bytes(payload, "little"), int.from_bytes(payload, "big")
                for name, bits, selectors, read in ours:
                    if told is None or name not in told:
                        if told is not None:
                            assert not selected(selectors, payload), (seed, message.name, name)
                            absent += 1
                        continue
                    assert selected(selectors, payload), (seed, message.name, name)
                    values = [0.0]
                    wrong = read(little, big, values)
                    if wrong:
                        assert math.isnan(told[name]), (seed, name, wrong)
                    else:
                        assert same(values[0], float(told[name])), (seed, message.name, name, payload.hex())
                    compared += 1
                    assert same(bits.raw(payload), float(message.decode(payload, scaling=False, decode_choices=False)[name]))
    assert compared > 20_000
    assert absent > 1000
    assert nested > 10


@pytest.mark.slow
def test_every_frame_that_is_sent_is_what_cantools_would_send() -> None:
    draw, compared, refused = random.Random(7), 0, 0
    for seed in range(400, 480):
        text = random_dbc.Dbc(seed).text
        reference: Any = cantools.database.load_string(text, database_format="dbc")
        for message in reference.messages:
            signals = [s for s in message.signals if not s.is_multiplexer]
            others = [f"{m.name}.{s.name}" for m in reference.messages if m is not message for s in m.signals]
            if not signals or not others:
                continue
            chosen = draw.choice(signals)
            branch = [
                s for s in signals if s.multiplexer_signal == chosen.multiplexer_signal and s.multiplexer_ids == chosen.multiplexer_ids
            ]
            names = tuple(s.name for s in branch)
            options = {
                "dbc": {"file": "random.dbc", "text": text},
                "robot": {"interface": "virtual"},
                "states": {"x": {"signal": others[0], "scale": 1.0}},
                "inputs": {name: {"signal": f"{message.name}.{name}", "scale": 1.0} for name in names},
            }
            if not all(holds_zero(s) for s in branch):
                with pytest.raises(ConfigError, match="zero input, which stops the robot, cannot be sent"):
                    CanTransport(options, ("x",), names)
                refused += 1
                continue
            transport = CanTransport(options, ("x",), names)
            for _ in range(5):
                u = tuple(within(draw, s) for s in branch)
                (record,) = records(transport.encode(Command(1, 0, "sampler", u, 0, 1)).data)
                told = message.decode(record.payload[: message.length], decode_choices=False)
                for name, value, signal in zip(names, u, branch, strict=True):
                    # rounded to the nearest step; a float of 32 bits has 24 of mantissa, counted from the physical value or its offset
                    step = abs(float(signal.scale)) if not signal.conversion.is_float else 2**-23 * (abs(value) + abs(signal.offset))
                    assert abs(float(told[name]) - value) <= 0.5001 * step + 1e-12 * abs(value), (seed, name)
                again = message.encode(told, scaling=True, padding=False, strict=False)
                assert again == record.payload[: message.length], (seed, message.name)
                compared += 1
    assert compared > 300
    assert refused > 5


def holds_zero(signal: Any) -> bool:
    raw = -signal.offset / signal.scale
    low, high = limits(signal)
    return signal.conversion.is_float or (low <= round(raw) <= high and abs(raw - round(raw)) < 1e-9)


def limits(signal: Any) -> tuple[int, int]:
    return (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.is_signed else (0, (1 << signal.length) - 1)


def within(draw: random.Random, signal: Any) -> float:
    """A physical value that the signal, and an input, can hold."""
    if signal.conversion.is_float:
        return draw.uniform(-1e6, 1e6)
    low, high = limits(signal)
    edge = int(5e8 / abs(signal.scale))
    return float(draw.randint(max(low, -edge), min(high, edge)) * signal.scale + signal.offset)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (' SG_ S : 60|16@1+ (1,0) [0|0] "m" B', "does not fit the 8 bytes"),
        (' SG_ S : 7|16@1+ (0,0) [0|0] "m" B', "the scale 0"),
        (' SG_ S : 0|16@1+ (1,0) [5|1] "m" B', "holds nothing"),
        (' SG_ S : 0|16@1+ (1,0) [0|0] "furlong" B', "the unit 'furlong', which is not known here: give its scale"),
    ],
)
def test_signal_that_cannot_be_read_is_refused(line: str, says: str) -> None:
    text = f'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A B\n\nBO_ 1 Odd: 8 A\n{line}\n'
    database = Database({"file": "odd.dbc", "text": text})
    with pytest.raises(ConfigError, match=says):
        scaled(database.signal("Odd.S", "transport.states.x"), Source("Odd.S"), "transport.states.x")


def test_signal_whose_branch_the_dbc_forgot_is_not_taken_for_one_that_is_always_there() -> None:
    text = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A B\n\nBO_ 1 Odd: 8 A\n SG_ M M : 0|4@1+ (1,0) [0|0] "" B\n'
    text += ' SG_ A m0M : 8|8@1+ (1,0) [0|0] "" B\n SG_ C m1 : 16|8@1+ (1,0) [0|0] "" B\n SG_ D m3 : 32|8@1+ (1,0) [0|0] "" B\n'
    text += "\nSG_MUL_VAL_ 1 A M 0-0;\nSG_MUL_VAL_ 1 C A 1-1;\n"
    database = Database({"file": "odd.dbc", "text": text})
    with pytest.raises(ConfigError, match=r"Odd\.D is multiplexed, but not by what"):
        database.signal("Odd.D", "transport.states.x")
    assert isinstance(database.signal("Odd.C", "transport.states.x"), Named)
