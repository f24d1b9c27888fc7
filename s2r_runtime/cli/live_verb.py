"""Verbs that show a run to people and their tools: live, export. They read the log, and nothing waits for them."""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from s2r_runtime.api.files import apart, writable
from s2r_runtime.cli import output
from s2r_runtime.cli.choices import positive
from s2r_runtime.cli.daemon_verbs import add_daemon_options
from s2r_runtime.errors import UsageError

if TYPE_CHECKING:
    from s2r_runtime.live.foxglove_stream import Stream
    from s2r_runtime.live.series import Series
    from s2r_runtime.live.source import Replay, Running

POLL_S = 0.02
HOST = "127.0.0.1"
PORT_MAX = 65535


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    live = verbs.add_parser("live", epilog="Ctrl-C ends it. It reads the log and never holds up the daemon.")
    live.add_argument(
        "log", type=Path, nargs="?", metavar="LOG", help="a log to replay, a run's first file (default: follow the daemon that runs here)"
    )
    live.add_argument(
        "--foxglove",
        nargs="?",
        const="",
        required=True,
        metavar="PORT",
        help="serve the Foxglove WebSocket protocol there, for Foxglove and Lichtblick (default port: 8765; 0: any that is free)",
    )
    live.add_argument("--host", default=HOST, metavar="ADDRESS", help=f"address to listen on (default: {HOST}, this machine alone)")
    live.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="URL",
        help="let pages of this origin connect, such as https://lichtblick.example (default: pages of this machine, Foxglove's own, and "
        "programs that are no page); may be repeated",
    )
    live.add_argument("--speed", type=positive, default=1.0, metavar="X", help="of a log that is replayed (default: 1, as it was)")
    add_daemon_options(live)
    live.set_defaults(run=run_live)

    export = verbs.add_parser("export")
    export.add_argument(
        "log", type=Path, nargs="+", metavar="LOG", help="the first file of a run; its other parts are found by their names"
    )
    export.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.mcap", help="where the channels for viewers go")
    export.add_argument("--json", action="store_true", help="print one JSON object")
    export.set_defaults(run=run_export)


def run_live(args: argparse.Namespace) -> int:
    """Exit 0 when it is ended by a person."""
    from s2r_runtime.live.foxglove_stream import PORT, Stream
    from s2r_runtime.live.series import WANTED, Series, topics
    from s2r_runtime.live.source import Replay, Running

    port = _port(args, PORT)
    source = Running(WANTED, args.robot, args.socket) if args.log is None else Replay(args.log, WANTED, args.speed)
    series = Series(source.attached, source.folder)
    if isinstance(source, Running):
        series.begin(source.started, source.status)
    stream = Stream(f"s2r {source.robot}", args.host, port, topics(source.started.settings).values(), args.origin)
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(stream):
        output.err(f"s2r: Foxglove WebSocket at ws://{args.host}:{stream.port} (Ctrl-C ends it)")
        _stream(source, series, stream)
    return 0


def _stream(source: Running | Replay, series: Series, stream: Stream) -> NoReturn:
    """Until it is interrupted."""
    last_ns, said = 0, ""
    while True:
        rows = source.poll()
        for row in rows:
            for sample in series.take(row):
                stream.send(sample)
                last_ns = sample.log_ns
        if rows:
            stream.time(last_ns)
        if stream.newcomer() and (shown := series.scene(last_ns)) is not None:
            stream.send(shown)
        if (trouble := series.simulation.trouble) != said:
            said = trouble
            output.err(f"s2r: {trouble}" if trouble else "s2r: residual and scenario are computed again")
        if not rows:
            time.sleep(POLL_S)


def run_export(args: argparse.Namespace) -> int:
    """Exit 0 with the file written."""
    from s2r_runtime.live.export import export

    for log in args.log:
        if not log.is_file():
            raise UsageError(f"{log}: no such log file")
        apart({"-o": args.output}, {"the log": log})
    writable(args.output)
    counts = export(args.log, args.output, lambda line: output.err(f"s2r: {line}"))
    if args.json:
        output.result_json({"output": str(args.output), "channels": counts})
    else:
        output.out(f"{sum(counts.values())} messages written to {args.output}")
        for name, n in counts.items():
            output.out(f"  {name:12s} {n}")
    return 0


def _port(args: argparse.Namespace, default: int) -> int:
    """Of --foxglove. What follows it may be the log as well. Raises UsageError."""
    given: str = args.foxglove
    if given and not given.isdecimal() and args.log is None:
        args.log, given = Path(given), ""
    if given and not (given.isdecimal() and int(given) <= PORT_MAX):
        raise UsageError(f"--foxglove: is {given}, must be a port, 0 to {PORT_MAX}")
    return int(given) if given else default
