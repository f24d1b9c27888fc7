"""Tampers with signed logs in every way that is known here, and counts what goes unseen (docs/log-format.md, guarantee "no log can lie").

    tools/bench_tamper.py [--count 100000] [--seed 1] [--quick] [--json]

The logs hold every kind of record, and are signed. A mutation changes bytes, or takes the log apart and puts it together again with
every CRC, index, statistic and, by effort, every head fitting (tools/log_forger.py). Seen: the log is not read as the closed log of the
trusted key any more. Named: the first record that is not vouched for is that of the first block that differs (or the next one, where a
block says the same in other bytes: its own seal cannot speak of those). One in twenty is recovered too, and readers of others must open
the result. Exit 0: all were seen, all were named, all that was recovered opens.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import zstandard
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, DataEnd, Footer, Schema, Statistics

sys.path.insert(0, str(Path(__file__).resolve().parent))

from log_forger import Effort, Msg, Parts, Piece, apart, copied, forge

from s2r_runtime.errors import RecordingError, S2RError
from s2r_runtime.messages import Ask, Command, Decided, Frame, GateChanged, Measured, Observation, Observed, Proposed, Send, Struct, Ticked
from s2r_runtime.recording.layout import MAGIC, attachment_fields, attachment_record, metadata_record, pack
from s2r_runtime.recording.reading import read
from s2r_runtime.recording.salvage import recover
from s2r_runtime.recording.writer import Writer

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))
STATISTICS = (
    "message_count",
    "schema_count",
    "channel_count",
    "attachment_count",
    "metadata_count",
    "chunk_count",
    "message_start_time",
    "message_end_time",
)
RECOVER_EVERY = 20
"""Every so many mutations what is left is recovered too, and opened by readers of others."""
TRUSTED = KEY.public_key().public_bytes_raw()


@dataclass
class Target:
    """A log, its blocks' places in the file, and another log of the same key to splice from. indices: of each block's first message."""

    data: bytes
    parts: Parts
    offsets: list[int]
    indices: list[int]
    head: bytes
    other: Target | None = None

    def block_at(self, offset: int) -> int:
        """The block that a byte of the file belongs to; their number for what follows the data."""
        return bisect_right(self.offsets, offset) - 1


def record(path: Path, seed: int, blocks: int, per_block: int) -> None:
    """A run as a daemon logs it: all that is needed here is that every kind of record is there."""
    rng = random.Random(seed)
    attached = [("profile.toml", "application/toml", b"[robot]\nname = 'r'\n"), ("model.toml", "application/toml", b"name = 'unicycle'\n")]
    writer = Writer(path, run=f"run-{seed}", signer=KEY, metadata={"robot": "r"}, attachments=attached, timed=False)
    for k in range(blocks * per_block):
        t = k * 1_000_000
        x = (rng.gauss(0, 1), rng.gauss(0, 1), rng.uniform(-3, 3))
        made: tuple[Struct, ...] = (
            Frame(t, "robot/observation", rng.randbytes(40)),
            Observed(t, Observation(k, t, x)),
            Ask(t, "controller", k),
            Proposed(t, Command(k, t, "controller", x[:2], k, 100_000_000)),
            Decided(t, "controller", k, k, rng.random() < 0.9, "allowed", 0.1),
            Send(t, k, "controller", x[:2], k, 100_000_000),
            Measured(t, k, abs(x[0]), "", 1.0, k, 0),
            GateChanged(t, rng.random() < 0.5, "allowed"),
            Ticked(t),
        )
        writer.write(made[k % len(made)], t)
        if k % per_block == per_block - 1:
            writer.flush()
        if k == blocks * per_block // 2:
            writer.attach("controller/sha256:aa", "application/json", rng.randbytes(200))
            writer.attach("certificate/sha256:bb", "application/json", rng.randbytes(150))
    writer.close()


def target(path: Path) -> Target:
    """Raises AssertionError if the forger does not make a log again as it was: then its other work would prove nothing."""
    data, parts = path.read_bytes(), apart(path)
    assert forge(parts, "bytes") == data
    reading = read(path)
    assert reading.to_the_end().kind == "closed"
    offsets, indices = list[int](), list[int]()
    at = seen = 0
    for number, piece in enumerate(parts.pieces):
        offsets.append(at)
        indices.append(seen)
        seen += len(piece.messages)
        at = len(forge(Parts(parts.start, parts.pieces[: number + 1], closing=False), "bytes"))
    return Target(data, parts, [*offsets, at], [*indices, seen], reading.head)


# ---------------------------------------------------------------- bytes

Mutator = Callable[[Target, random.Random], bytes]


def flip(t: Target, rng: random.Random) -> bytes:
    """One bit, or a few."""
    data = bytearray(t.data)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        place = rng.randrange(8 * len(data))
        data[place // 8] ^= 1 << place % 8
    return bytes(data)


def overwrite(t: Target, rng: random.Random) -> bytes:
    """A run of bytes by zeros or noise."""
    data, n = bytearray(t.data), rng.choice((1, 4, 8, 64, 4096))
    at = rng.randrange(len(data))
    run = bytes(n) if rng.random() < 0.3 else rng.randbytes(n)
    data[at : at + n] = run[: len(data) - at]
    return bytes(data)


def _span(t: Target, rng: random.Random) -> tuple[int, int]:
    at = rng.randrange(len(t.data))
    return at, min(len(t.data), at + rng.choice((1, 8, 31, 500, 5000)))


def remove(t: Target, rng: random.Random) -> bytes:
    """A stretch taken out."""
    a, b = _span(t, rng)
    return t.data[:a] + t.data[b:]


def insert(t: Target, rng: random.Random) -> bytes:
    """A stretch put in: zeros, noise, or what stands there once more."""
    a, b = _span(t, rng)
    put = rng.choice((bytes(b - a), rng.randbytes(b - a), t.data[a:b]))
    return t.data[:a] + put + t.data[a:]


def swap(t: Target, rng: random.Random) -> bytes:
    """Two stretches exchanged."""
    (a, b), (c, d) = sorted((_span(t, rng), _span(t, rng)))
    c = max(b, c)
    d = max(c, d)
    return t.data[:a] + t.data[c:d] + t.data[b:c] + t.data[a:b] + t.data[d:]


def cut(t: Target, rng: random.Random) -> bytes:
    """The end cut off."""
    return t.data[: rng.randrange(len(t.data))]


def cut_with_zeros(t: Target, rng: random.Random) -> bytes:
    """The end replaced by zeros, as after a power cut."""
    at = rng.randrange(len(t.data))
    return t.data[:at] + bytes(rng.choice((1, 16, 4096, len(t.data) - at)))


def pad(t: Target, rng: random.Random) -> bytes:
    """Something put behind the end."""
    return t.data + rng.choice((b"\0", bytes(16), bytes(4096), MAGIC, rng.randbytes(9), t.data, pack(DataEnd(0)), t.data[-200:]))


def header(t: Target, rng: random.Random) -> bytes:
    """The file says that it is another format, or library."""
    old, new = rng.choice(((b"log 2", b"log 1"), (b"s2r-runtime", b"S2R-runtime"), (MAGIC, MAGIC[:5] + b"1\r\n")))
    return t.data.replace(old, new, 1)


def ending(t: Target, rng: random.Random) -> bytes:
    """What follows the data, made otherwise: standard readers find their way by it."""
    end = t.offsets[-1]
    data, rest = t.data[:end], t.data[end:]
    crc = zlib.crc32(data)
    made = (
        data + pack(DataEnd(0)) + rest[13:],
        data + pack(DataEnd(crc)) + pack(DataEnd(crc)) + rest[13:],
        data + pack(DataEnd(crc)) + pack(Footer(0, 0, 0)) + MAGIC,
        data + rest[: -37 - 8] + pack(Footer(end + 13, 0, 0)) + MAGIC,
        data + rest[:13] + pack(Statistics(**dict.fromkeys(STATISTICS, 0), channel_message_counts={})) + rest[13:],
        data + rest[:13] + pack(Channel(1, "event/observed", "json", {}, 1)) + rest[13:],
        data + rest[13:],
        data + metadata_record("s2r.recovered", {"missing": ""}) + rest,
        data + metadata_record("note", {"approved": "yes"}) + rest,
        data + attachment_record("certificate/sha256:cc", "application/json", 0, b"{}") + rest,
    )
    return rng.choice(made)


# ---------------------------------------------------------------- records


Change = Callable[[Parts, random.Random, Target], None]


def _message(p: Parts, rng: random.Random) -> tuple[Piece, int]:
    """A message, rarely a seal."""
    piece = rng.choice(p.pieces)
    last = len(piece.messages) - 1
    return piece, last if rng.random() < 0.1 or last == 0 else rng.randrange(last)


def change_data(p: Parts, rng: random.Random, _: Target) -> None:
    """One digit of one message."""
    piece, i = _message(p, rng)
    m = piece.messages[i]
    at = rng.choice([k for k, c in enumerate(m.data) if 48 <= c <= 57] or [0])
    digit = rng.choice([d for d in b"0123456789" if d != m.data[at]])
    piece.messages[i] = Msg(m.channel, m.sequence, m.log_time, m.publish_time, m.data[:at] + bytes([digit]) + m.data[at + 1 :])


def second_key(p: Parts, rng: random.Random, _: Target) -> None:
    """Another value under the same name: readers differ in which one they show."""
    piece, i = _message(p, rng)
    m = piece.messages[i]
    piece.messages[i] = Msg(m.channel, m.sequence, m.log_time, m.publish_time, b'{"t_ns":1,' + m.data[1:])


def change_field(p: Parts, rng: random.Random, _: Target) -> None:
    """One field of a message's record: channel, number or time."""
    piece, i = _message(p, rng)
    m = piece.messages[i]
    channel, sequence, log_time, publish_time = m.channel, m.sequence, m.log_time, m.publish_time
    match rng.randrange(5):
        case 0:
            channel = rng.choice([c for c in range(1, 12) if c != channel])
        case 1:
            sequence = (sequence + rng.choice((-1, 1, 1 << 31))) & 0xFFFFFFFF
        case 2:
            log_time = publish_time = max(0, log_time + rng.choice((-1, 1, 10**9)))
            log_time, publish_time = (log_time, publish_time) if log_time != m.log_time else (1, 1)
        case 3:
            publish_time += rng.choice((1, 10**9))
        case _:
            log_time += rng.choice((1, 10**9))
    piece.messages[i] = Msg(channel, sequence, log_time, publish_time, m.data)


def drop(p: Parts, rng: random.Random, _: Target) -> None:
    """One message taken out."""
    piece, i = _message(p, rng)
    del piece.messages[i]
    _renumber(p, rng)


def duplicate(p: Parts, rng: random.Random, _: Target) -> None:
    """One message twice."""
    piece, i = _message(p, rng)
    piece.messages.insert(i, piece.messages[i])
    _renumber(p, rng)


def put_in(p: Parts, rng: random.Random, t: Target) -> None:
    """A message of another run put in."""
    piece, i = _message(p, rng)
    assert t.other is not None
    foreign = rng.choice(rng.choice(t.other.parts.pieces).messages)
    piece.messages.insert(i, foreign)
    _renumber(p, rng)


def replace(p: Parts, rng: random.Random, t: Target) -> None:
    """A message with another one's content."""
    piece, i = _message(p, rng)
    m = piece.messages[i]
    other = rng.choice([o for q in p.pieces for o in q.messages if o.data != m.data])
    piece.messages[i] = Msg(other.channel, m.sequence, m.log_time, m.publish_time, other.data)


def reorder(p: Parts, rng: random.Random, _: Target) -> None:
    """Two neighbours exchanged, with or without their numbers and times."""
    piece = rng.choice([q for q in p.pieces if len(q.messages) > 2])
    i = rng.randrange(len(piece.messages) - 2)
    piece.messages[i], piece.messages[i + 1] = piece.messages[i + 1], piece.messages[i]
    if rng.random() < 0.5:
        piece.messages[i], piece.messages[i + 1] = (
            Msg(m.channel, old.sequence, old.log_time, old.publish_time, m.data)
            for m, old in ((piece.messages[i], piece.messages[i + 1]), (piece.messages[i + 1], piece.messages[i]))
        )


def _renumber(p: Parts, rng: random.Random) -> None:
    """Sequence numbers fit again, in two of three cases."""
    if rng.random() < 0.33:
        return
    number = p.pieces[0].messages[0].sequence if p.pieces[0].messages else 0
    for piece in p.pieces:
        for i, m in enumerate(piece.messages):
            piece.messages[i] = Msg(m.channel, number, m.log_time, m.publish_time, m.data)
            number += 1


def declare(p: Parts, rng: random.Random, _: Target) -> None:
    """Channels and schemas: what standard readers call a message, and how they show it."""
    piece = p.pieces[0] if rng.random() < 0.7 else rng.choice(p.pieces)
    made = rng.randrange(5)
    if made == 0 and piece.declarations:
        i = rng.randrange(len(piece.declarations))
        d = piece.declarations[i]
        piece.declarations[i] = d.replace(b"event/", b"evenf/").replace(b"properties", b"propertieS").replace(b"json", b"jsom")
    elif made == 1:
        piece.declarations.append(pack(Channel(2, "event/other", "json", {}, 2)))
    elif made == 2:
        number = rng.choice((1, 2, 500))
        piece.declarations += [pack(Schema(number, b"{}", "jsonschema", "x")), pack(Channel(number, "x", "json", {"a": "b"}, number))]
    elif made == 3 and piece.declarations:
        piece.declarations.append(rng.choice(piece.declarations))
    else:
        piece.declarations.append(rng.choice((metadata_record("x", {}), b"\x80\x00\x00\x00\x00\x00\x00\x00\x00", pack(Footer(0, 0, 0)))))


def attachments(p: Parts, rng: random.Random, t: Target) -> None:
    """What is attached: exchanged, removed, or changed in its name, time, type or content."""
    places = [(q, i) for q in p.pieces for i in range(len(q.prefix))]
    (a, i), (b, j) = rng.sample(places, 2)
    one, other = attachment_fields(a.prefix[i]), attachment_fields(b.prefix[j])
    match rng.randrange(7):
        case 0:  # contents exchanged under their names
            a.prefix[i] = attachment_record(one.name, one.media_type, one.log_time_ns, other.data)
            b.prefix[j] = attachment_record(other.name, other.media_type, other.log_time_ns, one.data)
        case 1:
            a.prefix[i], b.prefix[j] = b.prefix[j], a.prefix[i]
        case 2:
            del a.prefix[i]
        case 3:
            a.prefix[i] = attachment_record(one.name, one.media_type, one.log_time_ns + 1, one.data)
        case 4:
            a.prefix[i] = attachment_record(one.name, one.media_type, one.log_time_ns, one.data + b" ")
        case 5:
            rng.choice(p.pieces).prefix.append(attachment_record(one.name, one.media_type, 0, b"another one"))
        case _:
            rng.choice(p.pieces).prefix.append(metadata_record("s2r", {"run": "another"}))


def blocks(p: Parts, rng: random.Random, t: Target) -> None:
    """Whole blocks taken out, exchanged or repeated."""
    i = rng.randrange(len(p.pieces) - 1)
    match rng.randrange(5):
        case 0:
            del p.pieces[i]
        case 1:
            p.pieces[i], p.pieces[i + 1] = p.pieces[i + 1], p.pieces[i]
        case 2:
            p.pieces.insert(i, p.pieces[i])
        case 3:  # cut, and closed again
            del p.pieces[i + 1 :]
        case _:
            del p.pieces[i : i + rng.randrange(1, 3)]


def splice(p: Parts, rng: random.Random, t: Target) -> None:
    """From some block on, another run."""
    assert t.other is not None
    i = rng.randrange(1, len(p.pieces))
    p.pieces[i:] = copied(t.other.parts).pieces[min(i, len(t.other.parts.pieces) - 1) :]


def foreign_block(p: Parts, rng: random.Random, t: Target) -> None:
    """One block of another run."""
    assert t.other is not None
    i = rng.randrange(len(p.pieces) - 1)
    p.pieces[i] = rng.choice(copied(t.other.parts).pieces[:-1])


def form(p: Parts, rng: random.Random, _: Target) -> None:
    """The same content in another form: zstd knows many."""
    i = rng.randrange(len(p.pieces))
    piece = p.pieces[i]
    content = b"".join(piece.declarations) + b"".join(m.record() for m in piece.messages)
    plain = zstandard.ZstdCompressor(level=1).compress(content)
    skippable = b"\x50\x2a\x4d\x18\x04\x00\x00\x00abcd"
    piece.data = rng.choice((
        zstandard.ZstdCompressor(level=rng.choice((3, 9, 19))).compress(content),
        zstandard.ZstdCompressor(level=1, write_checksum=True).compress(content),
        plain + rng.randbytes(4),
        plain + skippable,
        skippable + plain,
        plain + zstandard.ZstdCompressor(level=1).compress(b"more"),
        zstandard.ZstdCompressor(level=1, write_content_size=False).compress(content),
        plain,
    ))  # fmt: skip


def derived(p: Parts, rng: random.Random, _: Target) -> None:
    """What follows from the content, not fitting it."""
    piece = rng.choice(p.pieces)
    if rng.random() < 0.5:
        first, last = piece.messages[0].log_time, piece.messages[-1].log_time
        piece.times = rng.choice(((first + 1, last), (first, last + 1), (0, 1 << 62)))
    else:
        piece.index = rng.choice((b"", b"\x07" + (6).to_bytes(8, "little") + (1).to_bytes(2, "little") + bytes(4)))


BYTES: tuple[Mutator, ...] = (flip, flip, flip, overwrite, remove, insert, swap, cut, cut_with_zeros, pad, header, ending)
RECORDS: tuple[Change, ...] = (
    change_data,
    change_data,
    second_key,
    change_field,
    drop,
    duplicate,
    put_in,
    replace,
    reorder,
    declare,
    attachments,
    blocks,
    splice,
    foreign_block,
    form,
    derived,
)
EFFORTS: tuple[Effort, ...] = ("bytes", "chain", "sign", "pose")


def mutate(t: Target, rng: random.Random) -> tuple[str, bytes]:
    """What was done, and the file."""
    if rng.random() < 0.5:
        mutator = rng.choice(BYTES)
        return mutator.__name__, mutator(t, rng)
    change, effort = rng.choice(RECORDS), rng.choice(EFFORTS)
    parts = copied(t.parts)
    change(parts, rng, t)
    since = next((i for i, piece in enumerate(parts.pieces) if i >= len(t.parts.pieces) or piece != t.parts.pieces[i]), len(parts.pieces))
    return f"{change.__name__}, {effort}", forge(parts, effort, OTHER, 0 if effort == "pose" else since)


def judged(t: Target, data: bytes, path: Path) -> tuple[str, str]:
    """(how it was seen, what is wrong with that): "" and why if it went unseen."""
    path.write_bytes(data)
    try:
        reading = read(path)
        end = reading.to_the_end()
    except RecordingError:
        return "no log", ""
    where = next((i for i, (a, b) in enumerate(zip(data, t.data, strict=False)) if a != b), min(len(data), len(t.data)))
    block = t.block_at(where)
    wanted = t.indices[block : block + 2]
    if reading.public_key != TRUSTED:
        return "another key", ""
    if end.kind in {"closed", "rotated"}:
        return "", f"read as {end.kind}"
    if end.kind == "cut" and reading.head == t.head and not reading.sealed_for_good:
        return "", "read to the last head, and called cut"
    if end.index not in wanted:
        return end.kind, f"named record {end.index}, the first block that differs begins at {wanted[0]} ({end.detail})"
    return end.kind, ""


def recovered(data: bytes, folder: Path) -> str:
    """What is wrong with what `s2r log recover` makes of it, or empty: other readers must open it, indexed and not."""
    source, out = folder / "source.mcap", folder / "recovered.mcap"
    source.write_bytes(data)
    out.unlink(missing_ok=True)
    try:
        account = recover(source, out)
    except S2RError:
        return ""  # nothing to recover, said in one line
    try:
        with out.open("rb") as file:
            reader = SeekingReader(file, validate_crcs=True)
            indexed = sum(1 for _ in reader.iter_messages())
            attached = [one.name for one in reader.iter_attachments()]
        with out.open("rb") as file:
            streamed = sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))
    except Exception as error:  # noqa: BLE001 - whatever a reader of others raises
        return f"the recovered file does not open: {type(error).__name__}: {error}"
    if indexed != streamed or indexed != account["records"]:
        return f"the recovered file has {indexed} messages by its index, {streamed} in all; recover says {account['records']}"
    return "" if len(attached) <= 8 else "attachments appeared"


def run(count: int, seed: int) -> tuple[Counter[str], Counter[str], list[str]]:
    """(mutations by what was done, by how they were seen, what went unseen or was misnamed)."""
    rng, did, seen, wrong = random.Random(seed), Counter[str](), Counter[str](), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{i}.mcap" for i in range(3)]
        for i, path in enumerate(paths):
            record(path, i, blocks=4 + 2 * i, per_block=9 + 9 * i)
        targets = [target(path) for path in paths]
        for i, one in enumerate(targets):
            one.other = targets[i - 1]
        place = Path(folder) / "tampered.mcap"
        while sum(did.values()) < count:
            one = rng.choice(targets)
            what, data = mutate(one, rng)
            if data == one.data:
                continue
            did[what] += 1
            how, problem = judged(one, data, place)
            seen[how or "UNSEEN"] += 1
            if sum(did.values()) % RECOVER_EVERY == 0:
                problem = problem or recovered(data, Path(folder))
            if problem:
                wrong.append(f"{what}: {problem}")
    return did, seen, wrong


def main() -> int:
    """Exit 0 if nothing went unseen or was misnamed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="2000 mutations")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    begun = time.process_time()
    did, seen, wrong = run(2000 if args.quick else args.count, args.seed)
    unseen = seen["UNSEEN"]
    if args.json:
        print(
            json.dumps(
                {
                    "mutations": sum(did.values()),
                    "kinds": did,
                    "seen": seen,
                    "unseen": unseen,
                    "misnamed": len(wrong) - unseen,
                    "wrong": wrong[:20],
                }
            )
        )
    else:
        for what, n in sorted(did.items()):
            print(f"{n:8d}  {what}")
        print(f"{sum(did.values())} mutations of {len(did)} kinds, seed {args.seed}: {unseen} unseen, {len(wrong) - unseen} misnamed")
        print(
            "seen as: "
            + ", ".join(f"{n} {how}" for how, n in seen.most_common())
            + f"; {time.process_time() - begun:.0f} s of the processor"
        )
        for line in wrong[:20]:
            print("  " + line)
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
