"""Several log files as what they are: the parts of a run in order, and runs in the order given."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from s2r_runtime.errors import RecordingError
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Entry, Reading


def runs(paths: Sequence[Path], channels: Iterable[str] | None = None) -> list[list[Reading]]:
    """The files' readings, a list a run: runs as they are first met, parts by number. Raises RecordingError."""
    if not paths:
        raise RecordingError("no log was given")
    wanted = None if channels is None else tuple(channels)
    found: dict[str, list[Reading]] = {}
    for path in paths:
        reading = Reading(path, wanted)
        found.setdefault(reading.run or str(path), []).append(reading)
    for parts in found.values():
        parts.sort(key=lambda reading: reading.part)
        for before, after in pairwise(parts):
            if before.part == after.part:
                raise RecordingError(f"{after.path}: is part {after.part} of run {after.run!r}, and so is {before.path}")
    return list(found.values())


def is_log(path: Path) -> bool:
    """Whether a file begins as a log of this version does (or would, if it were not cut)."""
    try:
        Reading(path)
    except RecordingError:
        return False
    return True


class Log:
    """One or more files, read once through. Constant memory but for the attachments."""

    def __init__(self, paths: Sequence[Path], channels: Iterable[str] | None = None) -> None:
        self.readings = [reading for parts in runs(paths, channels) for reading in parts]

    def entries(self) -> Iterator[Entry]:
        """All messages (without the seals), in order. Stops within a file where that is damaged; `ending` says so."""
        for reading in self.readings:
            yield from reading

    @property
    def attachments(self) -> list[Attached]:
        """Those that stood before what was read so far."""
        return [one for reading in self.readings for one in reading.attachments]

    def models(self) -> dict[str, ModelSpec]:
        """The attached models, by digest."""
        from s2r_runtime.modelspec import parse_model

        texts = [one for one in self.attachments if one.name == "model.toml" or one.name.startswith("model/")]
        specs = [parse_model(one.data.decode(), ".", one.name) for one in texts]
        return {spec.digest(): spec for spec in specs}

    def ending(self) -> str:
        """How the last file ended, in a few words; what was damaged before it comes first."""
        said = []
        for reading in self.readings:
            end = reading.ending
            if end.kind == "broken":
                said.append(f"{reading.path.name} is damaged after {end.index} messages ({end.detail})")
            elif end.kind == "cut":
                said.append(f"{reading.path.name} was cut after {end.index} messages ({end.detail})")
        last = self.readings[-1]
        if last.ending.kind in {"closed", "rotated"}:
            said.append("closed properly" if last.ending.kind == "closed" else "goes on in another file")
        return "; ".join(said)


def read_all(paths: Sequence[Path], channels: Iterable[str] | None = None) -> Log:
    """Opens files for reading, in the order of their runs and parts."""
    return Log(paths, channels)
