"""How a log begins: magic, header, and the metadata that says which run it is of, which key seals it, and what it continues."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from mcap.opcode import Opcode
from mcap.records import Header

from s2r_runtime.errors import RecordingError
from s2r_runtime.recording.chain import GENESIS
from s2r_runtime.recording.layout import ABOUT, LIBRARY, MAGIC, RECORD, START_MAX, metadata_fields, metadata_record, pack
from s2r_runtime.recording.origin import other_writer

FIRST = MAGIC + pack(Header("", LIBRARY))


class Start(NamedTuple):
    """raw: the bytes; empty if the file ends before they do. `first_index`: number of the first message in the run.

    `key`: that seals are signed with, or None; `previous_head`: of the part that this one continues.
    """

    raw: bytes = b""
    fields: Mapping[str, str] = {}
    run: str = ""
    part: int = 0
    first_index: int = 0
    key: Ed25519PublicKey | None = None
    previous_head: bytes = GENESIS


def make_start(
    fields: Mapping[str, str], *, run: str, part: int = 1, first_index: int = 0, public_key: bytes = b"", previous_head: bytes = GENESIS
) -> bytes:
    """The bytes that a log begins with. fields: versions and the like."""
    own = {"run": run, "part": str(part), "first_index": str(first_index)}
    chain = {"public_key": public_key.hex(), "previous_head": previous_head.hex()}
    return FIRST + metadata_record(ABOUT, {**fields, **own, **chain})


def read_start(file: BinaryIO, path: Path, size: int) -> Start:
    """Reads the start of a file of `size` bytes. Raises RecordingError if it is no log, or its start is damaged."""
    found = file.read(min(len(FIRST), size))
    if not found.strip(b"\0"):  # a power cut before the first sync left nothing of its beginning, or zeros
        return Start()
    if found != FIRST[: len(found)]:
        if other := other_writer(path):
            raise RecordingError(f"{path}: is an MCAP file of others ({other}), not a log of s2r")
        raise RecordingError(f"{path}: is not a log of this version of s2r (its first bytes are not those of one)")
    head = file.read(RECORD.size)
    if len(FIRST) + RECORD.size > size or len(FIRST) + RECORD.size + RECORD.unpack(head)[1] > size:
        return Start()
    if RECORD.unpack(head)[1] > START_MAX:
        raise RecordingError(f"{path}: its metadata is damaged: it claims {RECORD.unpack(head)[1]} bytes, at most {START_MAX} are read")
    record = head + file.read(RECORD.unpack(head)[1])
    try:
        name, fields = metadata_fields(record)
        key = bytes.fromhex(fields["public_key"])
        start = Start(
            found + record,
            fields,
            fields["run"],
            int(fields["part"]),
            int(fields["first_index"]),
            Ed25519PublicKey.from_public_bytes(key) if key else None,
            bytes.fromhex(fields["previous_head"]),
        )
        if start.part < 1 or (start.part == 1 and start.first_index):
            raise ValueError(f"part {start.part} begins with message {start.first_index}")
    except (ValueError, KeyError) as error:
        raise RecordingError(f"{path}: its metadata is damaged: {error}") from None
    if name != ABOUT or head[0] != Opcode.METADATA:
        raise RecordingError(f"{path}: begins with metadata {name!r}, a log begins with {ABOUT!r}")
    return start
