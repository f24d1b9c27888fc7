"""The chain vouches for every bit up to the last signature, also against somebody who can repair everything but that."""

from __future__ import annotations

import hashlib
from array import array
from pathlib import Path

import msgspec
import pytest
import zstandard
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.errors import RecordingError
from s2r_runtime.messages import Ticked
from s2r_runtime.recording.blocks import take
from s2r_runtime.recording.chain import GENESIS, advance, is_signed_by, signed
from s2r_runtime.recording.channels import Seal
from s2r_runtime.recording.layout import MESSAGE, chunk
from s2r_runtime.recording.writer import Writer, read

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))


def record(path: Path, key: Ed25519PrivateKey | None = KEY, chunks: int = 6) -> None:
    writer = Writer(path, run="test", signer=key, timed=False)
    for i in range(chunks * 10):
        writer.write(Ticked(i), i)
        if i % 10 == 9:
            writer.flush()
    writer.close()


def test_a_head_is_the_hash_of_the_one_before_the_seal_and_the_records() -> None:
    assert advance(GENESIS, b"", [b"a", b"bc"]) == hashlib.sha256(bytes(32) + b"abc").digest()
    assert advance(b"h" * 32, b"seal", [b"abc"]) == hashlib.sha256(b"h" * 32 + b"sealabc").digest()


def test_a_signature_is_over_every_field_and_for_this_purpose_only() -> None:
    seal = signed(Seal(1, 2, b"h" * 32, b"f" * 32), KEY)
    assert is_signed_by(seal, KEY.public_key())
    assert not is_signed_by(seal, OTHER.public_key())
    for field, value in (("t_ns", 2), ("count", 3), ("head", b"g" * 32), ("file", b"g" * 32), ("end", "closed")):
        assert not is_signed_by(msgspec.structs.replace(seal, **{field: value}), KEY.public_key()), field
    bare = msgspec.json.encode(msgspec.structs.replace(seal, signature=b""))
    assert not is_signed_by(msgspec.structs.replace(seal, signature=KEY.sign(bare)), KEY.public_key())


def blocks(path: Path) -> list[tuple[bytes, list[tuple[int, int, int, bytes]], bytes]]:
    """(bytes before the chunk, messages, declarations) of each block; the start of the file belongs to the first."""
    data = path.read_bytes()
    start, found, at = read(path).start, [], 0
    with path.open("rb") as file:
        while True:
            file.seek(at or len(start))
            block = take(file, at, len(data), b"" if at else start)
            assert block is not None
            if block.last:
                return found
            messages = [(channel, number, t_ns, block.content[begin:end]) for channel, number, t_ns, begin, end in block.messages]
            found.append((b"".join(block.prefix), messages, b"".join(block.declarations)))
            at = block.end


def forge(path: Path, key: Ed25519PrivateKey | None, change: int, *, rechain: bool) -> None:
    """One message of block `change` altered; CRCs and indexes made to fit. The log then ends like one that a crash cut.

    rechain: all heads fit too; the seals from there on are signed with `key`, or keep the old signatures.
    """
    data, head, seal_record = b"", GENESIS, b""
    for number, (prefix, messages, declarations) in enumerate(blocks(path)):
        content, index = bytearray(declarations), {}
        for position, (channel, sequence, t_ns, raw) in enumerate(messages):
            if number == change and position == 3:
                raw = raw.replace(b"3", b"7")
            if position == len(messages) - 1:
                if rechain:
                    head = advance(head, seal_record, [prefix, content])
                    old = msgspec.json.decode(raw, type=Seal)
                    seal = msgspec.structs.replace(old, head=head, file=hashlib.sha256(data).digest())
                    if number >= change:
                        seal = signed(msgspec.structs.replace(seal, signature=b""), key) if key else seal
                    raw = msgspec.json.encode(seal)
                seal_at = len(content)
            index.setdefault(channel, array("Q")).extend((t_ns, len(content)))
            content += MESSAGE.pack(5, 22 + len(raw), channel, sequence, t_ns, t_ns) + raw
        seal_record = bytes(content[seal_at:])
        compressor = zstandard.ZstdCompressor(level=1) if len(messages) > 1 else None
        data += prefix + chunk(bytes(content), index, messages[0][2], messages[-1][2], compressor)
    path.write_bytes(data)


def ending(path: Path) -> tuple[str, int, str]:
    reading = read(path)
    end = reading.to_the_end()
    return end.kind, end.index, end.detail


@pytest.mark.parametrize("change", [0, 2, 4])
def test_a_message_changed_under_the_old_seals_is_named(tmp_path: Path, change: int) -> None:
    record(tmp_path / "a.mcap")
    forge(tmp_path / "a.mcap", None, change, rechain=False)
    kind, index, detail = ending(tmp_path / "a.mcap")
    assert (kind, index) == ("broken", 11 * change)
    assert "chain does not hold" in detail


@pytest.mark.parametrize("change", [0, 2, 4])
def test_a_chain_made_to_fit_lacks_the_signature(tmp_path: Path, change: int) -> None:
    for key in (None, OTHER):
        path = tmp_path / f"{key is None}.mcap"
        record(path)
        forge(path, key, change, rechain=True)
        kind, index, detail = ending(path)
        assert (kind, index) == ("broken", 11 * change)
        assert "signature" in detail


def test_the_forger_of_these_tests_makes_a_sound_log_when_he_has_the_key(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    forge(tmp_path / "a.mcap", KEY, 2, rechain=True)
    reading = read(tmp_path / "a.mcap")
    messages = [entry.message for entry in reading]
    assert messages[23] == Ticked(27)
    assert len(messages) == 60


def test_an_unsigned_log_says_so_and_cannot_pose_as_signed(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", None)
    reading = read(tmp_path / "a.mcap")
    assert reading.to_the_end().kind == "closed"
    assert reading.chain == "unsigned tail"
    record(tmp_path / "b.mcap")
    signed_log = read(tmp_path / "b.mcap")
    signed_log.to_the_end()
    assert signed_log.chain == "intact"
    assert signed_log.public_key == KEY.public_key().public_bytes_raw()


def test_a_log_of_another_version_is_refused_with_the_message_named(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", None)
    forge(tmp_path / "a.mcap", None, 1, rechain=True)  # its `7` is still a number
    assert ending(tmp_path / "a.mcap")[0] == "cut"
    for prefix, text in ((b'"type":"ticked"', b'"type":"ticket"'), (b'"t_ns"', b'"t_xx"')):
        path = tmp_path / f"{prefix!r}.mcap".replace('"', "").replace("'", "")
        record(path, None)
        data = rewritten(path, prefix, text)
        path.write_bytes(data)
        with pytest.raises(RecordingError, match=r"message 0 \(event/ticked\) is of another version"):
            [entry.message for entry in read(path)]


def rewritten(path: Path, old: bytes, new: bytes) -> bytes:
    """The first block alone, its messages altered, chained and unsigned."""
    prefix, messages, declarations = blocks(path)[0]
    content, index = bytearray(declarations), {}
    for channel, sequence, t_ns, raw in messages[:-1]:
        index.setdefault(channel, array("Q")).extend((t_ns, len(content)))
        raw = raw.replace(old, new)
        content += MESSAGE.pack(5, 22 + len(raw), channel, sequence, t_ns, t_ns) + raw
    channel, sequence, t_ns, raw = messages[-1]
    seal = msgspec.structs.replace(msgspec.json.decode(raw, type=Seal), head=advance(GENESIS, b"", [prefix, content]))
    raw = msgspec.json.encode(seal)
    index.setdefault(channel, array("Q")).extend((t_ns, len(content)))
    content += MESSAGE.pack(5, 22 + len(raw), channel, sequence, t_ns, t_ns) + raw
    return prefix + chunk(bytes(content), index, messages[0][2], t_ns, zstandard.ZstdCompressor(level=1))
