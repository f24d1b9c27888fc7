"""Datasets from files: a table (CSV, CSV.gz) or a log of the daemon (MCAP, one part or several).

In a log the states are the observations that carry no fault, on the robot's clock. A command acts from the stamp of the observation
that it answers, plus what the daemon took to answer (`obs_seq` ties the two clocks together); in lockstep that is nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from s2r_runtime.dataset import Array, Dataset, Stream, columns_of, from_streams
from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import ComposedModel

MCAP_MAGIC = b"\x89MCAP"


def load_dataset(
    path: Path | str | Sequence[Path | str], model: ComposedModel, columns: Mapping[str, str] | None = None, *, epoch: int | None = None
) -> Dataset:
    """Reads a recording on the model's grid. columns: name in the model -> column of the table. Several paths: parts of one log.
    epoch: of a log, only what was recorded while that campaign was under way.

    Raises RecordingError (unreadable, lacks a column, too slow for the model's dt).
    """
    paths = tuple(Path(p) for p in ([path] if isinstance(path, str | Path) else path))
    digests = tuple(_digest(p) for p in paths)
    source = ", ".join(str(p) for p in paths)
    if _is_log(paths[0]):
        return from_streams(model, _log_segments(paths, model, epoch), source, digests, paths)
    return from_streams(model, _table_segments(paths[0], model, columns or {}), source, digests, paths)


def _digest(path: Path) -> str:
    """As DESIGN G6 wants it: of the file's bytes."""
    try:
        with path.open("rb") as file:
            return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


def _is_log(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(MCAP_MAGIC)) == MCAP_MAGIC


def _table_segments(path: Path, model: ComposedModel, columns: Mapping[str, str]) -> list[tuple[Stream, Stream]]:
    from s2r_runtime.tables import read_csv

    names = columns_of(model, columns)
    table = read_csv(path, list(names.values()))
    states = np.column_stack([table.columns[names[s]] for s in model.states])
    inputs = np.column_stack([table.columns[names[i]] for i in model.inputs])
    where = np.zeros(len(table.t), dtype=np.int64) if table.segment is None else table.segment
    given = []
    for segment in np.unique(where):
        rows = where == segment
        t, y, u = table.t[rows], states[rows], inputs[rows]
        measured, commanded = ~np.isnan(y).all(axis=1), ~np.isnan(u).all(axis=1)
        given.append((Stream(t[measured], y[measured]), Stream(t[commanded], u[commanded])))
    return given


def _log_segments(paths: tuple[Path, ...], model: ComposedModel, epoch: int | None) -> list[tuple[Stream, Stream]]:
    from s2r_runtime.messages import CampaignFinished, Observed, Send, StartCampaign
    from s2r_runtime.reading import read

    segments: list[tuple[list[tuple[float, ...]], list[tuple[float, ...]]]] = [([], [])]
    stamps: dict[int, tuple[float, int]] = {}
    last_seq, last = -1, -float("inf")
    row: tuple[float, ...] = ()
    for path in paths:
        inside = epoch is None
        for entry in read(path, ("event/observed", "out/send", "out/start_campaign", "event/campaign_finished")):
            message = entry.message
            if isinstance(message, Observed) and not message.observation.fault:
                o = message.observation
                stamp = o.stamp_ns * 1e-9
                if o.seq < last_seq and stamp < last:  # both go back: the robot was started anew
                    segments.append(([], []))
                    stamps.clear()
                elif stamp <= last:
                    continue
                last_seq, last = o.seq, stamp
                stamps[o.seq] = (stamp, message.t_ns)
                _expect(len(o.x) == len(model.states), path, f"observations of {len(o.x)} states, the model has {len(model.states)}")
                row = (stamp, *o.x)
                if inside:
                    segments[-1][0].append(row)
            elif isinstance(message, Send) and inside and message.obs_seq in stamps:
                stamp, asked_ns = stamps[message.obs_seq]
                _expect(
                    len(message.u) == len(model.inputs), path, f"commands of {len(message.u)} inputs, the model has {len(model.inputs)}"
                )
                segments[-1][1].append((stamp + max(message.t_ns - asked_ns, 0) * 1e-9, *message.u))
            elif isinstance(message, StartCampaign) and message.epoch == epoch:
                inside = True
                segments.append(([row] if row else [], []))  # what the campaign is asked first is about this observation
            elif isinstance(message, CampaignFinished) and message.epoch == epoch:
                inside = False
        if reading.ending is not None and reading.ending.kind == "broken":
            raise RecordingError(f"{path}: is damaged {reading.ending.detail}")
    return [(_stream(y, len(model.states)), _stream(u, len(model.inputs))) for y, u in segments]


def _expect(ok: bool, path: Path, what: str) -> None:
    if not ok:
        raise RecordingError(f"{path}: has {what}")


def _stream(rows: list[tuple[float, ...]], width: int) -> Stream:
    """Sorted by stamp; equal stamps keep their order."""
    table: Array = np.array(rows, dtype=np.float64).reshape(-1, 1 + width)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Stream(table[:, 0], table[:, 1:])
