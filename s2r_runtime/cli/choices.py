"""Options that several verbs share: which model, which profile, and numbers with their ranges."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.errors import UsageError
from s2r_runtime.recordings.units import number_of

if TYPE_CHECKING:
    from s2r_runtime.api.models import Chosen
    from s2r_runtime.api.recordings import Recording
    from s2r_runtime.evidence.scores import Score


def add_model_options(verb: argparse.ArgumentParser) -> None:
    """--profile, --model, --dt, --param, --column."""
    verb.add_argument("--profile", type=Path, metavar="P", help="the robot's profile (TOML): model, columns, weights")
    verb.add_argument(
        "--model",
        metavar="M",
        help="a model's name, a Python file, or a model TOML (docs/recordings.md; s2r trace -o writes one); replaces a profile's",
    )
    verb.add_argument(
        "--dt", type=positive, metavar="DT", help="the model's step in s (needed with a name or a Python file; else instead of the file's)"
    )
    verb.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the model; may be repeated")
    verb.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="the table's column of a state, an input, or t (the stamps), of another name (else as a profile says); may be repeated",
    )
    add_limit(verb)


def add_limit(verb: argparse.ArgumentParser) -> None:
    """--max-gb."""
    verb.add_argument("--max-gb", type=positive, metavar="GB", help="largest table that is read, as text, unpacked (default 4)")


def add_enclose_options(verb: argparse.ArgumentParser) -> None:
    """--enclose, --rate, --because."""
    verb.add_argument(
        "--enclose",
        action="store_true",
        help="also compare scenarios with a tube that no disturbance in the gap set leaves (G13, docs/composition.md)",
    )
    verb.add_argument(
        "--rate",
        type=positive,
        metavar="L",
        help="with --enclose: the closed loop steps at most L times as far from its undisturbed run (default: linear feedback, exact)",
    )
    verb.add_argument("--because", default="", metavar="TEXT", help="with --rate: why that may be assumed; it is part of the statement")


def add_dbc(verb: argparse.ArgumentParser) -> None:
    """--dbc."""
    verb.add_argument(
        "--dbc", type=Path, metavar="FILE", help="of a CAN log: the file that says what its frames mean (DBC, KCD, SYM, ARXML)"
    )


def add_score_options(verb: argparse.ArgumentParser) -> None:
    """--range, --better. Which score it is, the verb's own option says."""
    verb.add_argument(
        "--range", type=number, nargs=2, metavar=("LOW", "HIGH"), help="range of the score, fixed before the runs (default: 0 1)"
    )
    verb.add_argument("--better", choices=("high", "low"), default="high", help="which end of the range is the good one (default: high)")


def score_of(args: argparse.Namespace, name: str) -> Score:
    """The score of --range and --better. Raises UsageError for a range that is empty."""
    from s2r_runtime.evidence.scores import SAFE, Score

    if name == SAFE.name:
        if args.range or args.better != "high":
            raise UsageError("--range and --better go with another score than safe, which is 1 for a safe run and 0 for another")
        return SAFE
    low, high = args.range or (0.0, 1.0)
    return Score(name, low, high, args.better)


def add_signal_options(verb: argparse.ArgumentParser) -> None:
    """--state, --input: which signal of a recording is what; --dbc."""
    add_dbc(verb)
    for option, what in (("--state", "state"), ("--input", "input")):
        verb.add_argument(
            option,
            action="append",
            default=[],
            metavar="NAME=SIGNAL",
            help=f"the signal that is this {what} of the model: TOPIC.FIELD, times a number if need be (*0.01); s2r topics lists them, "
            "usual names are guessed; may be repeated",
        )


def recording_of(args: argparse.Namespace, paths: Sequence[Path]) -> Recording:
    """What is read, and which of its columns or signals is what. Raises UsageError."""
    from s2r_runtime.api.recordings import Recording

    column = _renamed(args.column, "--column", "NAME=COLUMN, a state or an input of the model (or t, the stamps) and its column")
    signal = "NAME=SIGNAL, a name of the model and a signal of the recording"
    state, given = (_renamed(getattr(args, option, []), f"--{option}", signal) for option in ("state", "input"))
    return Recording(tuple(paths), column, state, given, getattr(args, "dbc", None), args.max_gb)


def _renamed(items: Sequence[str], option: str, form: str) -> dict[str, str]:
    """Name in the model -> name in the recording. Raises UsageError."""
    found: dict[str, str] = {}
    for item in items:
        name, sign, other = (part.strip() for part in item.partition("="))
        if not name or not sign or not other:
            raise UsageError(f"{option} {item}: must be {form}")
        if name in found:
            there = f"in {found[name]!r}" if option == "--column" else found[name]
            raise UsageError(f"{option} {item}: {name} is {there} already")
        found[name] = other
    return found


def chosen_model(args: argparse.Namespace) -> Chosen:
    """The model that the options name, and the profile if there is one. Raises UsageError or ConfigError."""
    from s2r_runtime.api.models import choose

    return choose(args.model, args.profile, args.dt, pairs(args.param, "--param"))


def probability(text: str) -> float:
    """argparse type: a number strictly between 0 and 1."""
    try:
        value = number_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"{text} must be between 0 and 1")
    return value


def number(text: str) -> float:
    """argparse type: a number."""
    try:
        return number_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def positive(text: str) -> float:
    """argparse type: a finite number > 0."""
    try:
        value = number_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} must be > 0 and finite")
    return value


def not_negative(text: str) -> float:
    """argparse type: a finite number >= 0."""
    try:
        return 0.0 if text.strip("0.") == "" and "0" in text else positive(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(str(error).replace("> 0", ">= 0")) from None


def count(text: str) -> int:
    """argparse type: a whole number >= 0."""
    if not (text.isdecimal() and text.isascii()):
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number >= 0")
    return int(text)


def weights(items: Sequence[str], states: tuple[str, ...]) -> dict[str, float]:
    """Weight by state, as --weight gives them. Raises UsageError with the option as it was written."""
    from s2r_runtime.api.models import weights_of

    found: dict[str, float] = {}
    for item in items:
        name, value = pair(item, "--weight")
        try:
            weights_of(states, {name: value}, None)
        except UsageError as error:
            raise UsageError(str(error).replace(f"{name}={value:g}", item)) from None
        found[name] = value
    return found


def pairs(items: Sequence[str], option: str) -> dict[str, float]:
    """NAME=NUMBER of each, the last one of a name. Raises UsageError naming the option."""
    return dict(pair(item, option) for item in items)


def pair(item: str, option: str) -> tuple[str, float]:
    """NAME=NUMBER. Raises UsageError naming the option."""
    name, sign, value = item.partition("=")
    try:
        number = number_of(value)
    except ValueError:
        number = float("nan")
    if not sign or not name or not abs(number) < float("inf"):
        raise UsageError(f"{option} {item}: must be NAME=NUMBER, finite")
    return name, number
