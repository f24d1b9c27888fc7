"""`s2r`: the verbs, their exit codes, and where an error ends up as one line.

Results go to stdout, everything else to stderr. Exit codes: 0 it holds, 1 it does not hold, 2 usage, 3 not enough evidence,
70 internal error, 78 bad configuration.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

from s2r_runtime.cli import output, supervised
from s2r_runtime.errors import NotEnoughEvidence, PluginError, S2RError

for _library in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_library, "1")  # the matrices here are small: threads of a linear algebra library only wait for each other

GROUPS = (
    "demo",
    "daemon_verbs",
    "evidence",
    "trace_verb",
    "topics_verb",
    "synthesize_verb",
    "certify",
    "trials_verb",
    "log_verbs",
    "plugin_verb",
    "keys_verb",
    "setup_verbs",
)
"""Modules of this package, each with `add(verbs)` and its functions `run(args) -> int`. Nothing heavy is imported at the top."""


class _Verbs(argparse._SubParsersAction):  # type: ignore[type-arg]  # generic for type checkers alone
    """A verb's own help page begins with what the list of verbs says of it."""

    def add_parser(self, name: str, **options: Any) -> argparse.ArgumentParser:
        """As argparse's, with a description."""
        summary: str = options["help"]
        verb: argparse.ArgumentParser = super().add_parser(name, **{"description": f"{summary[0].upper()}{summary[1:]}.", **options})
        return verb


class _Parser(argparse.ArgumentParser):
    """argparse, but an error is one line."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.register("action", "parsers", _Verbs)

    def error(self, message: str) -> None:  # type: ignore[override]
        """Prints the error and where the help is; exits with 2."""
        output.err(f"{self.prog}: {message} (see {self.prog} --help)")
        raise SystemExit(2)


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = _Parser(
        prog="s2r",
        description="Measures the gap between a robot and its model, and lets only certified controllers drive.",
        epilog="exit codes: 0 it holds, 1 it does not hold, 2 usage, 3 not enough evidence, 70 internal error, 78 bad configuration",
    )
    top.add_argument("--version", action="version", version=f"s2r {_version()}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=_Parser)
    for group in GROUPS:
        importlib.import_module(f"s2r_runtime.cli.{group}").add(verbs)
    return top


def main(argv: Sequence[str] | None = None, run: Callable[[argparse.Namespace], int] | None = None) -> int:
    """Runs one verb and returns its exit code; errors of the user's are one line on stderr, never a traceback.

    run: instead of the verb's own function.
    """
    output.stand_in_for_closed_streams()
    args = argparse.Namespace()
    try:
        try:
            args = parser().parse_args(argv)
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
