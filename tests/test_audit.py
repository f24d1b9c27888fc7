"""An honest log holds; a log with one lie in it does not, and the record that the lie stands in is named.

The liars sign their logs with the right key: what is tested here is that nothing is believed which can be computed. Against
those without the key there are test_chain and test_recording.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from audit_bench import KEY, OTHER, PUBLIC, Bench, entries

from s2r_runtime import messages as m
from s2r_runtime.audit.log import AuditResult, audit
from s2r_runtime.cli.main import main
from s2r_runtime.errors import ConfigError, NotEnoughEvidence, RecordingError
from s2r_runtime.recording import writer as writer_module
from s2r_runtime.recording.channels import CHANNELS, FRAME_IN, FRAME_OUT, NUMBERS, LogDeleted
from s2r_runtime.recording.logfile import Pending
from s2r_runtime.recording.recorder import Recorder
from s2r_runtime.recording.salvage import recover
from s2r_runtime.recording.writer import Writer, read


def whole_run(folder: Path, lie: str = "") -> Any:
    """Campaign, gap, certificate, a drive, a robot that changes, a certificate at the grown gap, an end."""
    bench = Bench(folder, lie).sample().drive(60)
    bench.gain = 2.0
    bench.steps(60)
    return bench.stop()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An honest run, for tests that only read it."""
    return whole_run(tmp_path_factory.mktemp("run"))


def test_a_log_without_a_record_proves_nothing(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    empty.touch()
    with pytest.raises(NotEnoughEvidence, match="no record could be read"):
        audit([empty])


# ---------------------------------------------------------------- honest logs


@pytest.mark.slow
def test_an_honest_run_holds_and_everything_in_it_was_recomputed(run: Any, tmp_path: Path) -> None:
    path = run.write(tmp_path / "a.mcap")
    result = audit([path], PUBLIC)
    assert result.ok, result.text()
    assert (result.chain, result.first_difference, result.missing, result.unchecked) == ("intact", None, [], [])
    seen = {kind: sum(isinstance(entry.message, kind) for entry in entries(path)) for kind in (m.Frame, m.Measured, m.SampleTaken)}
    assert result.recomputed["frames"] == seen[m.Frame] > 500
    assert result.recomputed["discrepancies"] == seen[m.Measured] > 50
    assert result.recomputed["samples"] == result.recomputed["samples found in the observations"] == seen[m.SampleTaken] == 14
    assert result.recomputed["gaps"] == 1
    events = sum(entry.channel.startswith("event/") for entry in entries(path))
    outputs = sum(entry.channel.startswith("out/") for entry in entries(path))
    assert (result.recomputed["events"], result.recomputed["outputs"]) == (events, outputs)
    assert all(one.valid for one in result.certificates)
    assert len(result.certificates) >= 1
    assert result.head == read_head(path)


def read_head(path: Path) -> str:
    reading = read(path)
    reading.to_the_end()
    return reading.head.hex()


@pytest.mark.slow
def test_the_result_has_the_keys_that_are_promised_and_is_plain_data(run: Any, tmp_path: Path) -> None:
    plain = audit([run.write(tmp_path / "a.mcap")]).to_json()
    assert {"ok", "records", "certificates", "first_difference", "missing", "chain"} <= plain.keys()
    assert {"id", "valid", "reason"} <= plain["certificates"][0].keys()
    assert msgspec.json.decode(msgspec.json.encode(plain)) == plain


@pytest.mark.slow
def test_parts_of_a_rotated_log_are_audited_as_one_in_any_order(run: Any, tmp_path: Path) -> None:
    run.write(tmp_path / "a.mcap", rotate_bytes=30_000)
    parts = sorted(tmp_path.glob("*.mcap"), key=lambda path: read(path).part, reverse=True)
    assert len(parts) > 2
    result = audit(parts)
    assert result.ok, result.text()
    without = audit([parts[-1], *parts[:-2]])
    assert not without.ok
    assert without.only_incomplete
    assert without.incomplete[0].startswith("part 2 of run ")
    assert without.text().startswith("INCOMPLETE INPUT: ")
    later = audit(parts[:-1])
    assert not later.ok
    assert later.only_incomplete
    assert later.incomplete[0].startswith("part 1 of run ")
    (alone,) = audit(parts[:1]).incomplete
    assert alone.startswith(f"parts {', '.join(map(str, range(1, len(parts))))} of run ")
    assert alone.endswith(f"({parts[0].name} is part {len(parts)})")
    assert main(["audit", str(parts[0])]) == 3
    head = bytes.fromhex(read_head(parts[-1]))
    asked = audit(parts[:1], heads=[head])
    assert asked.only_incomplete
    assert "the part that has the published head" in asked.incomplete[1]
    damaged = bytearray(parts[0].read_bytes())
    damaged[len(damaged) // 2] ^= 1
    parts[0].write_bytes(damaged)
    assert not audit(parts[:1]).only_incomplete  # what is there must hold all the same
    assert main(["audit", str(parts[0])]) == 1
    damaged[len(damaged) // 2] ^= 1
    parts[0].write_bytes(damaged)
    sooner = audit(parts[1:])
    assert sooner.ok
    assert sooner.missing[0] == f"what came after {parts[1].name}: it goes on in part {len(parts)}, which was not given"


def test_a_log_that_a_crash_cut_anywhere_holds_and_says_what_is_missing(run: Any, tmp_path: Path) -> None:
    data = run.write(tmp_path / "a.mcap").read_bytes()
    for tenths in range(1, 10):
        cut = tmp_path / f"{tenths}.mcap"
        cut.write_bytes(data[: len(data) * tenths // 10])
        result = audit([cut])
        assert result.ok, result.text()
        assert result.chain == "intact"
        assert "was cut after" in result.missing[0]
        recover(cut, tmp_path / f"{tenths}-whole.mcap")
        again = audit([tmp_path / f"{tenths}-whole.mcap"])
        assert (again.ok, again.records) == (True, result.records)


def test_a_campaign_that_was_interrupted_and_went_on_holds_over_both_logs(tmp_path: Path) -> None:
    first = Bench(tmp_path)
    first.step()
    first.ask("permit", duration_s=3600.0)
    first.ask("sample")
    while len(first.samples) < 6:
        first.step()
    first.interrupt()
    while first.state.memory.gap is None:
        first.step()
    path = first.drive(30).stop().write(tmp_path / "a.mcap")
    result = audit([path])
    assert result.ok, result.text()
    assert result.recomputed["gaps"] == 1
    assert result.recomputed["samples"] == 14


@pytest.mark.slow
def test_a_log_that_ran_out_of_disk_holds_and_counts_what_it_lacks(run: Any, tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap", run="bench", signer=KEY, timed=False)
    recorder = Recorder(writer, limit_bytes=100_000)
    with writer._writing:
        for item in run.items:
            if isinstance(item, tuple):
                recorder.attach(*item)
            else:
                recorder.put(item, getattr(item, "t_ns", 0))
    lost = recorder.close().unrecorded
    result = audit([tmp_path / "a.mcap"])
    assert result.ok, result.text()
    assert f"{lost} messages at the end were not recorded" in result.missing[0]


def test_a_log_that_the_daemon_deleted_is_missing_and_said_to_be(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.steps(5)
    bench.items.append(LogDeleted(bench.t_ns, "earlier", 2, 1000, "ab" * 32, "older than 30 days"))
    result = audit([bench.stop().write(tmp_path / "a.mcap")])
    assert result.ok, result.text()
    assert result.missing == [f"the log of run earlier (head {'ab' * 32}), which the daemon deleted: older than 30 days"]


# ---------------------------------------------------------------- keys


@pytest.mark.slow
def test_whose_key_it_is_decides_only_if_one_is_asked_for(run: Any, tmp_path: Path) -> None:
    path = run.write(tmp_path / "a.mcap")
    told = audit([path])
    assert told.ok
    assert "not compared with a trusted key" in told.signed_by
    other = audit([path], OTHER.public_key().public_bytes_raw())
    assert not other.ok
    assert "NOT by the trusted key" in other.signed_by
    unsigned = audit([run.write(tmp_path / "b.mcap", key=None)], PUBLIC)
    assert not unsigned.ok
    assert unsigned.chain == "unsigned tail"


@pytest.mark.slow
def test_a_head_that_was_published_must_be_reached(run: Any, tmp_path: Path) -> None:
    path = run.write(tmp_path / "a.mcap")
    head = bytes.fromhex(read_head(path))
    assert audit([path], heads=[head]).recomputed["published heads"] == 1
    data = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    cut = audit([tmp_path / "cut.mcap"], heads=[head])
    assert not cut.ok
    assert cut.first_difference is not None
    assert "its tail was cut off, or it is another log" in cut.first_difference.what
    assert cut.first_difference.index == cut.records


# ---------------------------------------------------------------- lies


@pytest.mark.parametrize(
    ("lie", "what"),
    [
        ("observation", "this is not what frame"),
        ("settings", "the settings are not those of the attached profile"),
        ("sample", "the campaign gives something else here"),
        ("input law", "the campaign gives something else here"),
        ("gap", "the gap of epoch 1 is another one"),
        ("an unpaid seed", "a seed is drawn for an attempt that waits for none"),
        ("safety", "the numbers of the law uniform are not those of its scenarios"),
        ("headroom", "the radii that were looked at are not those of the search"),
        ("certificate", "what it says is not what the evidence says"),
        ("signer", "which is not trusted here"),
        ("discrepancy", "the discrepancy (or what the watch makes of it) is another one"),
        ("an episode left out", "a run's end is not recorded"),
        ("a better episode", "what a run came to is not what the observations make of it"),
        ("an episode put in", "what a run came to is not what the observations make of it"),
        ("verdict", "the core gives another output here"),
        ("silent opening", "the core gives another output here"),
        ("send", "a frame left that no command of the core makes"),
    ],
)
def test_a_lie_is_named_where_it_stands(tmp_path: Path, lie: str, what: str) -> None:
    bench = whole_run(tmp_path, lie)
    assert bench.lie_at >= 0, "the bench never came to lie"
    path = bench.write(tmp_path / "a.mcap")
    result = audit([path], PUBLIC)
    assert not result.ok
    assert result.chain == "intact", "the liar has the key"
    assert result.first_difference is not None
    assert what in result.first_difference.what
    assert result.first_difference.index == entries(path)[bench.lie_at].index
    if lie in {"gap", "safety", "headroom", "certificate", "signer"}:
        assert not result.certificates[0].valid


def tampered(run: Any, path: Path, change: Callable[[list[Any]], int]) -> tuple[AuditResult, int]:
    """The audit of a log in which something was changed after the fact, and the index of the record that `change` says is wrong."""
    bench = Bench.__new__(Bench)
    bench.items = list(run.items)
    ordinal = change(bench.items)
    bench.write(path)
    return audit([path], PUBLIC), entries(path)[ordinal].index


def misrecorded(run: Any, path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[m.Struct, bytes, str], tuple[bytes, str]]) -> Path:
    """An honest run's log by a recorder that writes some messages otherwise: (message, its bytes, its channel) -> bytes, channel."""

    class Odd:
        def encode(self, message: m.Struct) -> bytes:
            raw = msgspec.json.encode(message)
            return change(message, raw, "")[0]

    write = Writer.write

    def odd(writer: Writer, message: m.Struct, t_ns: int) -> None:
        add = Pending.add
        own = (FRAME_IN if message.inbound else FRAME_OUT) if isinstance(message, m.Frame) else next(iter(CHANNELS_OF[type(message)]))
        number = NUMBERS[change(message, b"", own)[1]]
        writer._encoder = Odd()  # type: ignore[assignment]
        with monkeypatch.context() as within:
            within.setattr(Pending, "add", lambda block, channel, *rest: add(block, number if channel == NUMBERS[own] else channel, *rest))
            write(writer, message, t_ns)

    monkeypatch.setattr(Writer, "write", odd)
    bench = Bench.__new__(Bench)
    bench.items = list(run.items)
    return bench.write(path)  # type: ignore[no-any-return]


CHANNELS_OF = {kind: [name for name, one in CHANNELS.items() if one is kind] for kind in CHANNELS.values()}


@pytest.mark.slow
@pytest.mark.parametrize("raw", [b'{"type":"frame"}', b"\xff"])
def test_a_frame_that_is_none_is_refused_as_any_message_is(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raw: bytes) -> None:
    path = misrecorded(
        run,
        tmp_path / "odd.mcap",
        monkeypatch,
        lambda message, good, channel: (raw if isinstance(message, m.Frame) and not message.inbound else good, channel),
    )
    with pytest.raises(RecordingError, match=r"frame/out.* is of another version"):
        audit([path], PUBLIC)


MOVED = [(m.GateChanged, "out/decided", "another output"), (m.Frame, "frame/out", "the other direction")]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "channel", "what"), MOVED, ids=["output", "frame"])
def test_a_record_on_another_channel_is_no_record_of_its_own(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type, channel: str, what: str
) -> None:
    path = misrecorded(
        run, tmp_path / "odd.mcap", monkeypatch, lambda message, good, own: (good, channel if isinstance(message, kind) else own)
    )
    result = audit([path], PUBLIC)
    assert (result.ok, result.chain) == (False, "intact")
    assert result.first_difference is not None
    assert what in result.first_difference.what
    assert result.first_difference.channel == channel


@pytest.mark.slow
def test_an_output_that_can_be_read_in_two_ways_passes_on_no_platform(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = writer_module.environment
    monkeypatch.setattr(writer_module, "environment", lambda: {**environment(), "python": "another"})
    honest = Bench.__new__(Bench)
    honest.items = list(run.items)
    assert audit([honest.write(tmp_path / "honest.mcap")], PUBLIC).ok
    path = misrecorded(
        run,
        tmp_path / "odd.mcap",
        monkeypatch,
        lambda message, good, own: (
            good.replace(b'"open":', b'"open":false,"open":', 1) if isinstance(message, m.GateChanged) else good,
            own,
        ),
    )
    result = audit([path], PUBLIC)
    assert not result.ok
    assert result.first_difference is not None
    assert (result.first_difference.channel, result.first_difference.what) == ("out/gate_changed", "the core gives another output here")


def nth(items: list[Any], kind: type, n: int) -> int:
    return [i for i, item in enumerate(items) if isinstance(item, kind)][n]


def ordinal(items: list[Any], at: int) -> int:
    return sum(not isinstance(item, tuple) for item in items[:at])


@pytest.mark.parametrize("kind", [m.Observed, m.Proposed, m.Measured, m.Ask, m.Decided, m.Send, m.GateChanged, m.Persist, m.RadiusGrew])
def test_a_record_that_was_left_out_is_missed(run: Any, tmp_path: Path, kind: type) -> None:
    def leave_out(items: list[Any]) -> int:
        at = nth(items, kind, -1 if kind in {m.GateChanged, m.Persist, m.RadiusGrew} else 40)
        del items[at]
        return ordinal(items, at)

    result, index = tampered(run, tmp_path / "a.mcap", leave_out)
    assert not result.ok
    assert result.first_difference is not None
    late = 30 if kind in {m.Observed, m.Proposed, m.Measured} else 3  # an event's absence shows in what it would have led to
    assert index - 1 <= result.first_difference.index <= index + late


@pytest.mark.slow
def test_a_watch_that_falls_silent_is_noticed(run: Any, tmp_path: Path) -> None:
    def silence(items: list[Any]) -> int:
        at = nth(items, m.Measured, 30)
        items[at:] = [item for item in items[at:] if not isinstance(item, m.Measured)]
        return ordinal(items, at)

    result, index = tampered(run, tmp_path / "a.mcap", silence)
    assert result.first_difference is not None
    assert "a discrepancy before this is not recorded" in result.first_difference.what
    assert index <= result.first_difference.index <= index + 3


@pytest.mark.slow
@pytest.mark.parametrize("kind", [m.Ticked, m.Send, m.Revoked])
def test_a_record_that_was_put_in_is_noticed(run: Any, tmp_path: Path, kind: type) -> None:
    extra = {
        m.Ticked: m.Measured(0, 3, 0.0, "", 1.0, 1, 0, 1),
        m.Send: m.Send(0, 1, "controller", (0.4, 0.0), 1, 100_000_000),
        m.Revoked: m.Revoked(0, "x", "y"),
    }[kind]

    def put_in(items: list[Any]) -> int:
        at = nth(items, m.Observed, 100)
        items.insert(at, extra)
        return ordinal(items, at)

    result, index = tampered(run, tmp_path / "a.mcap", put_in)
    assert not result.ok
    assert result.first_difference is not None
    assert result.first_difference.index == index


@pytest.mark.slow
@pytest.mark.parametrize("what", ["event before", "frame before", "begins twice"])
def test_a_run_begins_once_and_with_nothing_before(run: Any, tmp_path: Path, what: str) -> None:
    def change(items: list[Any]) -> int:
        first = nth(items, m.Started, 0)
        if what == "begins twice":
            at = nth(items, m.Observed, 100)
            items.insert(at, msgspec.structs.replace(items[first], t_ns=items[at].t_ns))
        else:
            at = first
            kind = m.Measured(0, 3, 0.0, "", 1.0, 1, 0, 1) if what == "event before" else items[nth(items, m.Frame, 0)]
            items.insert(at, kind)
        return ordinal(items, at)

    result, index = tampered(run, tmp_path / "a.mcap", change)
    assert not result.ok
    assert result.first_difference is not None
    assert result.first_difference.index == index
    assert "begin" in result.first_difference.what


@pytest.mark.slow
def test_evidence_that_is_not_attached_is_missed(run: Any, tmp_path: Path) -> None:
    for name in ("controller/", "certificate/"):
        bench = Bench.__new__(Bench)
        bench.items = [item for item in run.items if not (isinstance(item, tuple) and item[0].startswith(name))]
        result = audit([bench.write(tmp_path / f"{name[:-1]}.mcap")])
        assert not result.ok
        assert not result.certificates[0].valid
        assert "not attached" in result.certificates[0].reason
    bench.items = [item for item in run.items if not (isinstance(item, tuple) and item[0] == "profile.toml")]
    with pytest.raises(ConfigError, match=r"profile\.toml is not attached"):
        audit([bench.write(tmp_path / "profile.mcap")])


@pytest.mark.slow
def test_a_profile_that_an_earlier_version_took_and_this_one_does_not_is_told_as_that(run: Any, tmp_path: Path) -> None:
    bench = Bench.__new__(Bench)
    loose = b'[recovery]\nkind = "hold"\ninput = { v = 500.0 }\n'
    bench.items = [
        (item[0], *item[1:-1], item[-1] + loose) if isinstance(item, tuple) and item[0] == "profile.toml" else item for item in run.items
    ]
    with pytest.raises(ConfigError, match=r"recovery\.input\.v is 500\.0, .*; this version takes no such profile,") as told:
        audit([bench.write(tmp_path / "profile.mcap")])
    assert "\n" not in str(told.value)


@pytest.mark.slow
def test_a_later_run_cannot_forget_what_an_earlier_one_spent(run: Any, tmp_path: Path) -> None:
    first = run.write(tmp_path / "a.mcap", run="first")
    memory = run.state.memory
    honest = Bench(tmp_path, memory=memory).stop().write(tmp_path / "b.mcap", run="second")
    assert audit([first, honest]).ok
    forgetful = Bench(tmp_path, memory=msgspec.structs.replace(memory, attempts=0)).stop().write(tmp_path / "c.mcap", run="third")
    assert audit([forgetful]).ok, "alone it cannot be seen"
    result = audit([first, forgetful])
    assert not result.ok
    assert result.first_difference is not None
    assert "forgets epochs or attempts" in result.first_difference.what


def test_a_run_that_rests_on_an_earlier_one_holds_with_it_and_alone(tmp_path: Path) -> None:
    earlier = Bench(tmp_path).sample().drive(60).stop()
    first = earlier.write(tmp_path / "a.mcap", run="first")
    second = Bench(tmp_path, memory=earlier.state.memory).drive(60).stop().write(tmp_path / "b.mcap", run="second")
    for logs in ([first, second], [second]):
        result = audit(logs)
        assert result.ok, result.text()
        assert result.recomputed["discrepancies"] > 50
        assert bool(result.missing) == (logs == [second]), "alone it says that gap and certificate are from an earlier log"
    shrunk = msgspec.structs.replace(earlier.state.memory, gap=msgspec.structs.replace(earlier.state.memory.gap, radius=1e-6))
    third = Bench(tmp_path, memory=shrunk).stop().write(tmp_path / "c.mcap", run="third")
    result = audit([first, third])
    assert result.first_difference is not None
    assert "the memory has another gap of epoch 1" in result.first_difference.what


@pytest.mark.slow
def test_damage_is_named_and_nothing_behind_it_is_believed(run: Any, tmp_path: Path) -> None:
    data = bytearray(run.write(tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 4
    (tmp_path / "a.mcap").write_bytes(data)
    result = audit([tmp_path / "a.mcap"])
    assert (result.ok, result.chain) == (False, "broken")
    assert result.first_difference is not None
    assert "damaged" in result.first_difference.what
    assert result.records == result.first_difference.index


@pytest.mark.slow
def test_no_flipped_bit_passes_an_audit(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.steps(12)
    data = bench.stop().write(tmp_path / "a.mcap").read_bytes()
    assert audit([tmp_path / "a.mcap"]).ok
    rng = random.Random(1)
    for place in [*range(8 * 40, 8 * 60), *(rng.randrange(8 * len(data)) for _ in range(300))]:
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        (tmp_path / "b.mcap").write_bytes(flipped)
        result = audit([tmp_path / "b.mcap"])
        assert not result.ok or result.missing, place
        assert result.chain == "broken" or "was cut" in result.missing[0], place


def test_what_is_no_log_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("no")
    with pytest.raises(RecordingError, match=r"a\.mcap"):
        audit([tmp_path / "a.mcap"])
    with pytest.raises(RecordingError, match="no log"):
        audit([])
