"""Recordings in robots' own formats (candump, tlog, ...), read by plug-ins: the hook `s2r_recordings`.

Which reader: of those that recognise the file's content (else of those for its suffix), the one that the profile's transport offers, or
the only one (it then gets no options). A log in one of them is ordinary driving: rows of states and rows of inputs, each on its own stamps.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, RecordingError, UsageError
from s2r_runtime.files.table_text import refuse_special as refuse_special_file
from s2r_runtime.hookspecs import HEAD_BYTES, ReadLog
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.recording.origin import other_writer
from s2r_runtime.recordings.formats.recognise import BAG, recognised
from s2r_runtime.recordings.tables import LARGEST, ArrayTable, Source, Table

Array = NDArray[np.float64]

MCAP_MAGIC = b"\x89MCAP"
GZIP_MAGIC = b"\x1f\x8b"
TABLE_SUFFIXES = (".csv",)


class Rows(NamedTuple):
    """t: (N,) s, ascending; values: (N, c), NaN where a column was not received."""

    t: Array
    values: Array


class Stretch(NamedTuple):
    """Contiguous driving: states (N, nx) and inputs (M, nu), each on its own stamps of one clock."""

    states: Rows
    inputs: Rows


class RobotLog(NamedTuple):
    """Its stretches of driving, and what a person should know of how they were read, one line each."""

    stretches: list[Stretch]
    notes: tuple[str, ...]


def sources_of(path: Source | str | Sequence[Source | str]) -> tuple[Source, ...]:
    """The recordings that are named: one, or several."""
    several = [path] if isinstance(path, str | Path | ArrayTable) else path
    return tuple(one if isinstance(one, ArrayTable) else Path(one) for one in several)


def refuse_special(source: Source) -> None:
    """Raises RecordingError for a pipe or a device, which may block or never end when it is opened."""
    if isinstance(source, Path):
        refuse_special_file(source)


def suffix_of(path: Path) -> str:
    """`.log` of `a.log` and of `a.log.gz`, in small letters."""
    name = path.name.lower()
    return Path(name.removesuffix(".gz")).suffix


def head_of(path: Path) -> bytes:
    """The first bytes of a regular file, unpacked if it is gzipped; empty for anything else. Raises OSError."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        data = file.read(HEAD_BYTES)
    if not data.startswith(GZIP_MAGIC):
        return data
    try:
        return zlib.decompressobj(31).decompress(data, HEAD_BYTES)
    except zlib.error:
        return b""


def readers_of(path: Path) -> list[str]:
    """Names of the offers that may read this file: those that recognise its content, else those for its suffix. Raises OSError."""
    form, named = _form_of(path), registry().names("recordings")
    if form:  # a bag is read by the plug-in of ROS 2, whatever its name; what has named signals by none
        return [name for name in named if form == BAG and name.partition(".")[2] == BAG]
    return known_by_content(path) or _readers_by_suffix(path)


def known_by_content(path: Path) -> list[str]:
    """Names of the offers that recognise the file's content. Raises OSError."""
    offers, head = registry(), head_of(path)
    if not head or head.startswith(MCAP_MAGIC):
        return []
    return [name for name in offers.names("recordings") if offers.recogniser(name)(head)]


def _readers_by_suffix(path: Path) -> list[str]:
    suffix = suffix_of(path)
    return [
        name for name in registry().names("recordings") if suffix and suffix not in TABLE_SUFFIXES and name.partition(".")[2] == suffix[1:]
    ]


def is_robot_log(path: Path) -> bool:
    """Whether an installed plug-in reads this file. An MCAP file is one if somebody else wrote it."""
    try:
        if (is_mcap(path) or path.suffix.lower() == ".mcap") and not other_writer(path):
            return False
        return bool(readers_of(path))
    except OSError:  # who reads it says what is wrong
        return bool(_readers_by_suffix(path))


def _form_of(path: Path) -> str:
    """Its format's reader, by its content; empty for one that has none, or that cannot be read."""
    try:
        form = recognised(path)
    except RecordingError:
        return ""
    return form.name if form else ""


def is_mcap(path: Path) -> bool:
    """Whether it begins as an MCAP does, whatever its name. Raises OSError, RecordingError for a pipe or a device."""
    refuse_special(path)
    with path.open("rb") as file:
        return file.read(len(MCAP_MAGIC)) == MCAP_MAGIC


def is_table(path: Path) -> bool:
    """Whether a recording is read as a table: it is no MCAP, has no named signals, and no plug-in reads it. One that cannot be read says so
    itself.
    """
    try:
        return not _form_of(path) and not is_mcap(path) and not is_robot_log(path)
    except OSError:
        return True


def has_columns(path: Source) -> bool:
    """Whether a recording is read by names that the user may say: a table, or a file with named signals that is no bag."""
    return isinstance(path, ArrayTable) or _form_of(path) not in ("", BAG) or is_table(path)


def read_robot_log(path: Path, model: ComposedModel, transport: Mapping[str, Any] | None) -> RobotLog:
    """Its stretches of driving. transport: the profile's table, or None. Raises RecordingError, ConfigError, UsageError."""
    try:
        offered = readers_of(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    own = next((name for name in offered if name.partition(".")[0] == (transport or {}).get("name")), "")
    if own:
        options = {name: value for name, value in (transport or {}).items() if name != "name"}
    elif len(offered) == 1:
        own, options = offered[0], {}
    else:
        raise UsageError(f"{path}: could be of {' or '.join(offered)}; a profile says whose it is: --profile P")
    read = registry().get("recordings", own)
    try:
        found = read(path, model.states, model.inputs, options)
    except ConfigError as error:
        if options:
            raise
        raise UsageError(f"{path}: is read with a profile that says what is in it (--profile P): {error}") from None
    given, notes = found if isinstance(found, ReadLog) else ReadLog(list(found))
    stretches = [Stretch(_rows(x, len(model.states), path, own), _rows(u, len(model.inputs), path, own)) for x, u in given]
    if not any(len(stretch.states.t) for stretch in stretches):
        raise RecordingError(f"{path}: holds no state of this model")
    return RobotLog(stretches, tuple(notes))


def _rows(given: tuple[Any, Any], width: int, path: Path, reader: str) -> Rows:
    """Checked: what a plug-in gives is taken at its word nowhere else."""
    t, values = np.asarray(given[0], dtype=np.float64), np.asarray(given[1], dtype=np.float64).reshape(-1, width)
    if t.shape != values.shape[:1] or not np.all(np.isfinite(t)) or np.any(np.diff(t) < 0.0) or np.any(np.abs(values) > LARGEST):
        raise RecordingError(f"{path}: the reader {reader!r} gave rows that are not in order, or not finite (or beyond {LARGEST:g})")
    kept = ~np.isnan(values).all(axis=1)
    return Rows(t[kept], values[kept])


def content_digest(stretches: list[Stretch], model: ComposedModel) -> str:
    """Of what the log says, whatever file says it (guarantee G6)."""
    names = (*model.states, *model.inputs)
    merged = [merged_rows(stretch) for stretch in stretches]
    t = np.concatenate([rows.t for rows in merged])
    values = np.concatenate([rows.values for rows in merged])
    return Table(t, {name: values[:, i] for i, name in enumerate(names)}, None).content_digest(names)


def merged_rows(stretch: Stretch) -> Rows:
    """Rows of states and inputs in one table, (N + M, nx + nu), by stamp; what was not received is NaN."""
    (t_x, x), (t_u, u) = stretch
    t = np.concatenate([t_x, t_u])
    values = np.full((len(t), x.shape[1] + u.shape[1]), np.nan)
    values[: len(t_x), : x.shape[1]] = x
    values[len(t_x) :, x.shape[1] :] = u
    order = np.argsort(t, kind="stable")
    return Rows(t[order], values[order])
