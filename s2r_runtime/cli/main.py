"""`s2r`: the verbs, their exit codes, and where an error ends up as one line.

Results go to stdout, everything else to stderr. Exit codes: 0 it holds, 1 it does not hold, 2 usage, 3 not enough evidence,
70 internal error, 78 bad configuration.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterable, Sequence
from importlib import metadata
from typing import Any, NoReturn

from s2r_runtime.cli import output, supervised
from s2r_runtime.cli.verbs import GROUPS, VERBS
from s2r_runtime.errors import NotEnoughEvidence, PluginError, S2RError

_ABOUT = "Measures the gap between a robot and its model, and lets only certified controllers drive."

for _library in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_library, "1")  # the matrices here are small: threads of a linear algebra library only wait for each other


class _Verbs(argparse._SubParsersAction):  # type: ignore[type-arg]  # generic for type checkers alone
    """A verb's own help page begins with its summary."""

    def add_parser(self, name: str, **options: Any) -> argparse.ArgumentParser:
        """As argparse's, with a description. Without `help`: a verb of the table."""
        summary: str = options["help"] if "help" in options else VERBS[name].summary
        options = {"help": summary, "description": f"{summary[0].upper()}{summary[1:]}.", **options}
        verb: argparse.ArgumentParser = super().add_parser(name, **options)
        return verb


class _Parser(argparse.ArgumentParser):
    """argparse, but an error is one line, and offers the nearest name there is."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.register("action", "parsers", _Verbs)

    def error(self, message: str) -> NoReturn:
        """Prints the error and where the help is; exits with 2."""
        output.err(f"{self.prog}: {message} (see {self.prog} --help)")
        raise SystemExit(2)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse's, but what is unknown is an error of the verb that does not know it."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            self.error(f"unknown argument {unknown[0]!r}{_nearest(unknown[0].partition('=')[0], options)}")
        return known, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            kind = "verb" if action.metavar == "VERB" else "word"
            near = _nearest(str(value), [*action.choices])
            self.error(f"unknown {kind} {value!r}{near or ': it can be ' + ', '.join(action.choices)}")
        super()._check_value(action, value)


def _nearest(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, known, 1, 0.6)
    return f"; did you mean {near[0]}?" if near else ""


def parser(argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The command line; of the verbs those that `argv` can need, so that no other's module is imported. Without it, all."""
    top = _Parser(
        prog="s2r",
        usage="s2r [-h] [--version] VERB ...",
        description=f"{textwrap.fill(_ABOUT, 80)}\n\n{_verbs_in_groups()}",
        epilog="exit codes: 0 it holds, 1 it does not hold, 2 usage, 3 not enough evidence,\n70 internal error, 78 bad configuration",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"s2r {_version()}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True, prog="s2r", parser_class=_Parser, help=argparse.SUPPRESS)
    first = argv[0] if argv else ""
    needed = () if first.startswith("-") else (VERBS[first],) if first in VERBS else VERBS.values()
    for module in dict.fromkeys(verb.module for verb in needed):
        importlib.import_module(f"s2r_runtime.cli.{module}").add(verbs)
    return top


def _verbs_in_groups() -> str:
    lines = []
    for heading, verbs in GROUPS.items():
        lines += [f"{heading}:"]
        for name, verb in verbs.items():
            lines += textwrap.wrap(f"  {name:<12}{verb.summary}", 80, subsequent_indent=" " * 14)
        lines += [""]
    return "\n".join(lines).rstrip()


def main(argv: Sequence[str] | None = None, run: Callable[[argparse.Namespace], int] | None = None) -> int:
    """Runs one verb and returns its exit code; errors of the user's are one line on stderr, never a traceback.

    run: instead of the verb's own function.
    """
    output.stand_in_for_closed_streams()
    args = argparse.Namespace()
    try:
        try:
            given = sys.argv[1:] if argv is None else argv
            args = parser(given).parse_args(given)
            run = run or args.run
            try:
                return run(args)
            except supervised.EndedBySignal:
                raise
            except SystemExit:
                raise PluginError("code of a model or an effect ended the program (sys.exit?) before there was an answer") from None
        finally:
            output.flush()  # also after --help, which ends by SystemExit
    except S2RError as error:
        missing, also = (error.missing, error.also) if isinstance(error, NotEnoughEvidence) else (None, {})
        output.fail(str(error), error.exit_code, as_json=getattr(args, "json", False), missing=missing, also=also)
        return error.exit_code
    except KeyboardInterrupt:
        output.err("interrupted")
        return 130
    except Exception as error:  # noqa: BLE001 - a defect of ours: said as one, with its code
        if os.environ.get("S2R_TRACEBACK"):
            for line in traceback.format_exc().splitlines():
                output.err(line)
        output.fail(
            f"internal error: {type(error).__name__}: {error} (set S2R_TRACEBACK=1 to see where)", 70, as_json=getattr(args, "json", False)
        )
        return 70


def entry() -> int:
    """The command: `main`, whose end is seen whatever others' code does (see `supervised`)."""
    argv = sys.argv[1:]
    if argv and argv[0] in supervised.VERBS and "--live" not in argv:
        return supervised.run(main)
    return main()


def _version() -> str:
    try:
        return metadata.version("s2r-runtime")
    except metadata.PackageNotFoundError:
        return "(not installed)"


if __name__ == "__main__":
    raise SystemExit(main())
