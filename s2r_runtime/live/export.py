"""A log's channels for viewers as an MCAP file of their own, for Foxglove, Lichtblick and PlotJuggler."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mcap.writer import CompressionType, Writer

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.live.feed import Feed
from s2r_runtime.live.series import WANTED, Sample, Series, Topic

LIBRARY = "s2r export"


def export(paths: Sequence[Path], out: Path, note: Callable[[str], None]) -> dict[str, int]:
    """Writes what viewers plot of these runs, and gives the number of messages by channel. paths: a file of each run, its first.

    note: takes what a person should know, a line. Raises UsageError if `out` cannot be written, RecordingError if a log holds no run.
    """
    counts: dict[str, int] = {}
    partial = out.with_name(out.name + ".part")
    try:
        with partial.open("wb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile="", library=LIBRARY)
            channels: dict[Topic, int] = {}
            for path in paths:
                before = sum(counts.values())
                for sample in _samples(path, note):
                    _write(writer, channels, sample, counts)
                if sum(counts.values()) == before:
                    raise RecordingError(f"{path}: holds no beginning of a run that could be read; give the run's first file")
            writer.finish()  # type: ignore[no-untyped-call]
        partial.replace(out)
    except OSError as error:
        raise UsageError(f"{out}: cannot be written: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
    return counts


def _samples(path: Path, note: Callable[[str], None]) -> Iterator[Sample]:
    """Of one run."""
    feed = Feed(path, WANTED)
    try:
        series = Series(feed.attached, path.parent)
        while feed.more():
            for row in feed.poll():
                yield from series.take(row)
        if series.simulation.trouble:
            note(f"{path}: {series.simulation.trouble}")
        if feed.skipped:
            note(f"{path}: {feed.skipped} chunks or messages could not be read and are left out")
    finally:
        feed.close()


def _write(writer: Writer, channels: dict[Topic, int], sample: Sample, counts: dict[str, int]) -> None:
    topic = sample.topic
    number = channels.get(topic)
    if number is None:
        schema = writer.register_schema(topic.schema_name, "jsonschema", topic.schema.encode())
        number = channels[topic] = writer.register_channel(topic.name, "json", schema)
    counts[topic.name] = counts.get(topic.name, 0) + 1
    writer.add_message(number, sample.log_ns, json.dumps(sample.data).encode(), sample.log_ns, counts[topic.name])
