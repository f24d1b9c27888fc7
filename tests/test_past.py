"""A robot's state that was put back from a copy, cut, edited or lost: the newest log knows better, or nothing starts."""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from daemon_rig import Rig

from s2r_runtime.daemon import past, persistence
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import MEMORY_SCHEMA, Gap, Memory, Persist, SampleTaken, Ticked
from s2r_runtime.recording.glance import glance
from s2r_runtime.recording.reading import Reading, read
from s2r_runtime.recording.writer import Writer

KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
OTHER = Ed25519PrivateKey.from_private_bytes(bytes(31) + b"\1")
PUBLIC = KEY.public_key().public_bytes_raw()
GAP = Gap(0.25, 0.5, 0.75, 50, "ball", (1.0, 1.0, 0.0525), 161, 0, 0.03, 0.0152, 1, "sha256:aa", "sha256:bb", {})
NOW = Memory(
    "rig",
    MEMORY_SCHEMA,
    epochs=1,
    attempts=3,
    gap=GAP,
    radius=0.3,
    revoked={"sha256:00": "watch"},
    alarm_epoch=1,
    watch_n=40,
    watch_exceedances=2,
    traced=True,
    refuted=("sha256:cc",),
)
"""What the newest log of these robots ends with."""


def changed(**changes: Any) -> Memory:
    return msgspec.structs.replace(NOW, **changes)


OLDER = {
    "an attempt": changed(attempts=2),
    "the whole budget": Memory("rig", MEMORY_SCHEMA),
    "a revocation": changed(revoked={}),
    "the alarm": changed(alarm_epoch=0),
    "the grown radius": changed(radius=0.25),
    "discrepancies": changed(watch_n=39),
    "exceedances": changed(watch_exceedances=1),
    "a traced effect": changed(traced=False),
    "refuted samples": changed(refuted=()),
    "that the campaign ended": changed(gap=None, radius=0.0, campaign_epoch=1, campaign_n=161),
}
NEWER = {
    "the same": NOW,
    "a further attempt": changed(attempts=4),
    "a further epoch under way": changed(epochs=2, campaign_epoch=2, campaign_n=200),
    "a further gap": changed(
        epochs=2, gap=msgspec.structs.replace(GAP, epoch=2), radius=0.1, alarm_epoch=0, watch_n=0, watch_exceedances=0
    ),
    "no gap any more": changed(gap=None, radius=0.0, watch_n=0, watch_exceedances=0, traced=False),
    "more discrepancies": changed(watch_n=50, watch_exceedances=3, radius=0.4),
    "a certificate more": changed(revoked={"sha256:00": "watch", "sha256:01": "a person"}),
}


def log(
    folder: Path,
    *memories: Memory,
    stamp: str = "20260101T000000Z",
    key: Ed25519PrivateKey | None = KEY,
    closed: bool = True,
    number: int | None = None,
) -> Path:
    """A log that ends with the last of these memories, and a little more. number: as the daemon counts its logs; None: as before it did."""
    path = folder / f"rig-{stamp}.mcap"
    metadata = {} if number is None else {past.NUMBER: str(number)}
    writer = Writer(path, run=path.stem, signer=key, metadata=metadata, timed=False)
    for second, memory in enumerate(memories, 1):
        writer.write(Persist(second, memory), second)
        for _ in range(50):
            writer.write(Ticked(second), second)
        writer.durable()
    writer.close() if closed else writer.abandon()
    return path


def reconciled(state: Memory, folder: Path) -> tuple[Memory, str]:
    said: list[str] = []
    return past.reconciled(state, past.Logs(folder, "rig", [PUBLIC]), [PUBLIC], said.append), "\n".join(said)


@pytest.mark.parametrize("closed", [True, False], ids=["closed", "cut"])
@pytest.mark.parametrize("lost", OLDER)
def test_a_state_that_forgets_something_counts_for_what_the_log_ends_with(tmp_path: Path, lost: str, closed: bool) -> None:
    log(tmp_path, Memory("rig", MEMORY_SCHEMA), NOW, closed=closed)
    memory, said = reconciled(OLDER[lost], tmp_path)
    assert memory == NOW
    assert "the saved state forgets" in said


@pytest.mark.parametrize("more", NEWER)
def test_a_state_that_knows_more_than_the_log_counts_as_it_is(tmp_path: Path, more: str) -> None:
    log(tmp_path, Memory("rig", MEMORY_SCHEMA), NOW)
    assert reconciled(NEWER[more], tmp_path) == (NEWER[more], "")


@pytest.mark.parametrize(
    "state",
    [
        changed(attempts=4, revoked={}),
        changed(gap=msgspec.structs.replace(GAP, radius=0.01)),
        changed(epochs=2, attempts=0),
        changed(gap=msgspec.structs.replace(GAP, transitions_digest="sha256:of another robot"), attempts=1),
    ],
    ids=["one up, one down", "a smaller gap", "epochs for attempts", "another robot's of that name"],
)
def test_a_state_and_a_log_that_each_know_what_the_other_does_not_start_nothing(tmp_path: Path, state: Memory) -> None:
    path = log(tmp_path, NOW)
    with pytest.raises(ConfigError, match="put the newest state") as refused:
        reconciled(state, tmp_path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "edit",
    [
        {"campaign_n": 161},
        {"watch_e_value": 1.0},
        {"watch_counts": ()},
        {"campaign_digest": "sha256:ee"},
        {"model_digest": "sha256:ff"},
    ],
    ids=lambda edit: next(iter(edit)),
)
def test_an_edited_state_that_spent_as_much_starts_nothing(tmp_path: Path, edit: dict[str, Any]) -> None:
    """Fewer samples than were fixed beforehand, or a watch that saw less, would be evidence of something else."""
    under_way = changed(epochs=2, campaign_epoch=2, campaign_n=200, watch_e_value=9.0, watch_counts=(38, 2), campaign_digest="sha256:dd")
    log(tmp_path, under_way)
    assert reconciled(under_way, tmp_path) == (under_way, "")
    with pytest.raises(ConfigError, match="put the newest state"):
        reconciled(msgspec.structs.replace(under_way, **edit), tmp_path)


def test_what_is_latched_in_the_log_or_in_an_older_state_stays_latched(tmp_path: Path) -> None:
    log(tmp_path, changed(latched=("emergency_stop",)))
    assert reconciled(NOW, tmp_path)[0] == changed(latched=("emergency_stop",))
    assert reconciled(changed(attempts=1, latched=("watch_alarm",)), tmp_path)[0].latched == ("emergency_stop", "watch_alarm")


def test_a_run_whose_clock_was_ahead_is_not_believed_again_once_a_person_cleared_it(tmp_path: Path) -> None:
    log(tmp_path, changed(latest_unix_s=4_000_000_000), stamp="20961002T070640Z")
    assert reconciled(changed(latest_unix_s=1_800_000_000), tmp_path)[0].latest_unix_s == 4_000_000_000
    right = changed(latest_unix_s=1_800_000_000, clock_cleared=1)
    log(tmp_path, right, stamp="20270115T080000Z")
    assert reconciled(right, tmp_path) == (right, "")


def spoilt(path: Path, chunk: int) -> Path:
    """The log with a bit flipped in that chunk (0: the first)."""
    data = bytearray(path.read_bytes())
    at = -1
    for _ in range(chunk + 1):
        at = data.index(b"\x28\xb5\x2f\xfd", at + 1)
    data[at + 40] ^= 1
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    "says", [*({"state": OLDER[lost]} for lost in OLDER), {"latched": ("emergency_stop",)}, {"latest_unix_s": 2**33}], ids=str
)
def test_an_own_log_that_is_damaged_and_knows_more_than_the_state_starts_nothing(tmp_path: Path, says: dict[str, Any]) -> None:
    state = says.get("state", NOW)
    path = spoilt(log(tmp_path, NOW, NOW, msgspec.structs.replace(NOW, **{k: v for k, v in says.items() if k != "state"})), 1)
    with pytest.raises(ConfigError, match="is damaged") as refused:
        reconciled(state, tmp_path)
    assert str(path) in str(refused.value)
    spoilt(log(tmp_path, NOW, NOW, stamp="20260102T000000Z"), 1)
    path.unlink()
    assert reconciled(NOW, tmp_path) == (NOW, "")


def forged(folder: Path, how: str, memory: Memory) -> Path:
    """A log that somebody without this robot's key put into its folder, with the newest name and number."""
    stamp, number = "22000101T000000Z", 10**12
    if how == "another key":
        return log(folder, memory, stamp=stamp, key=OTHER, number=number)
    if how == "no key":
        return log(folder, memory, stamp=stamp, key=None, number=number)
    if how == "this robot's public key":
        path = log(folder, memory, stamp=stamp, key=OTHER, number=number)
        path.write_bytes(path.read_bytes().replace(OTHER.public_key().public_bytes_raw().hex().encode(), PUBLIC.hex().encode()))
        return path
    if how == "a later part":
        path = forged(folder, "this robot's public key", memory)
        return path.rename(folder / "rig-20260101T000000Z.002.mcap")
    assert how == "a copy under another name"
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir(exist_ok=True)
    return log(elsewhere, memory, number=number).rename(folder / f"rig-{stamp}.mcap")


FORGED = ["another key", "no key", "this robot's public key", "a later part", "a copy under another name"]


@pytest.mark.parametrize("how", FORGED)
@pytest.mark.parametrize(
    "claim",
    [
        {"latched": ("emergency_stop", "two_robots")},
        {"latest_unix_s": 7_258_118_400},
        {"attempts": 10**9, "epochs": 10**9},
        {"attempts": 1, "revoked": {"sha256:ff": "nobody"}},
        {"revoked": {}, "latched": ("watch_alarm",), "attempts": 99},
    ],
    ids="+".join,
)
def test_a_forged_log_neither_latches_nor_expires_nor_stops_a_start(tmp_path: Path, how: str, claim: dict[str, Any]) -> None:
    log(tmp_path, NOW, number=7)
    path = forged(tmp_path, how, changed(**claim))
    memory, said = reconciled(NOW, tmp_path)
    assert memory == NOW
    assert path.name in said
    assert "\n" not in said


@pytest.mark.parametrize("how", FORGED)
def test_forged_logs_hide_none_of_the_robots_own(tmp_path: Path, how: str) -> None:
    log(tmp_path, NOW, number=7)
    path = forged(tmp_path, how, OLDER["an attempt"])
    for copy in range(past.RUNS + 1) if how != "a later part" else ():
        shutil.copy2(path, tmp_path / f"rig-2200010{copy + 2}T000000Z.mcap")
    logs = past.Logs(tmp_path, "rig", [PUBLIC])
    assert logs.next_number == 8
    assert reconciled(OLDER["an attempt"], tmp_path)[0] == NOW
    assert [path.name for path in past.campaign_logs(logs, "rig", 1)] == ["rig-20260101T000000Z.mcap"]


@pytest.mark.parametrize("how", FORGED[:3])
@pytest.mark.parametrize("claim", [0, 10**12], ids=["older", "newer"])
def test_a_foreign_first_part_makes_a_run_neither_older_nor_newer(tmp_path: Path, how: str, claim: int) -> None:
    """The run's own first part is gone, and its second one has its number."""
    for number in range(past.RUNS + 1):
        log(tmp_path, OLDER["an attempt"], stamp=f"2025010{number + 1}T000000Z", number=number + 1)
    run, number = "rig-20260101T000000Z", past.RUNS + 2
    writer = Writer(tmp_path / f"{run}.mcap", run=run, signer=KEY, metadata={past.NUMBER: str(number)}, timed=False, rotate_bytes=1)
    for memory in (OLDER["an attempt"], NOW):
        writer.write(Persist(1, memory), 1)
        writer.durable()
    writer.close()
    first, *rest = writer.parts
    assert rest
    first.unlink()
    forged(tmp_path, how, OLDER["an attempt"]).rename(first)
    if claim == 0:
        old = b"%d" % 10**12
        first.write_bytes(first.read_bytes().replace(old, b"0" * len(old)))
    logs = past.Logs(tmp_path, "rig", [PUBLIC])
    assert logs.next_number == number + 1
    assert next(logs.runs())[0] == rest[0]
    assert reconciled(OLDER["an attempt"], tmp_path)[0] == NOW


def test_runs_whose_clock_was_ahead_hide_none_that_came_after_them(tmp_path: Path) -> None:
    for number in range(past.RUNS + 1):
        log(tmp_path, OLDER["the whole budget"], stamp=f"2096010{number + 1}T000000Z", number=number + 1)
    log(tmp_path, NOW, stamp="20260101T000000Z", number=past.RUNS + 2)
    log(tmp_path, OLDER["the whole budget"], stamp="19700101T000000Z", number=past.RUNS)
    assert reconciled(OLDER["an attempt"], tmp_path)[0] == NOW
    assert past.Logs(tmp_path, "rig", [PUBLIC]).next_number == past.RUNS + 3


def test_a_log_with_a_number_is_newer_than_one_of_before_they_had_any(tmp_path: Path) -> None:
    for number in range(past.RUNS + 1):
        log(tmp_path, OLDER["an attempt"], stamp=f"2096010{number + 1}T000000Z")
    assert past.Logs(tmp_path, "rig", [PUBLIC]).next_number == 1
    log(tmp_path, NOW, number=1)
    assert reconciled(OLDER["an attempt"], tmp_path)[0] == NOW


def test_other_files_in_the_log_folder_hold_up_no_start(tmp_path: Path) -> None:
    """Opening a FIFO waits for whoever writes to it."""
    log(tmp_path, NOW)
    os.mkfifo(tmp_path / "rig-20270101T000000Z.mcap")
    (tmp_path / "rig-20270102T000000Z.mcap").symlink_to("/dev/zero")
    (tmp_path / "rig-20270103T000000Z.mcap").mkdir()
    (tmp_path / f"rig-20270104T000000Z-{'9' * 9}.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\xff" * 4096)
    (tmp_path / f"rig-20270104T000000Z-{'9' * 99}.mcap").write_bytes(b"")
    assert reconciled(OLDER["an attempt"], tmp_path)[0] == NOW
    assert list(glance(tmp_path / "rig-20270101T000000Z.mcap", past.SAID)) == []


def test_only_logs_of_this_robot_are_looked_at_and_an_unreadable_one_hides_none_before_it(tmp_path: Path) -> None:
    log(tmp_path, NOW)
    (tmp_path / "rig-2-20270101T000000Z.mcap").write_bytes(log(tmp_path, changed(robot="rig-2"), stamp="20270101T000000Z").read_bytes())
    for number in range(past.RUNS + 1):
        (tmp_path / f"rig-2027010{number + 1}T000000Z.mcap").write_bytes(b"")
    (tmp_path / "rig-20270101T000000Z-2.mcap").write_bytes(b"no log at all")
    assert reconciled(OLDER["an attempt"], tmp_path)[0] == NOW
    assert reconciled(changed(attempts=9), tmp_path / "nowhere")[0] == changed(attempts=9)


@pytest.mark.parametrize("cut", [0.0, 0.3, 0.6, 0.9])
def test_a_glance_gives_what_the_full_reading_gives_however_the_file_ends(tmp_path: Path, cut: float) -> None:
    path = log(tmp_path, *(changed(attempts=number) for number in range(20)))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - round(cut * len(data))])
    seen = list(glance(path, past.SAID))
    full = [entry.message for entry in read(path, past.SAID)]
    assert seen == full[: len(seen)]
    assert len(full) - len(seen) <= 1  # of a chunk whose index is not there
    assert list(glance(path, past.SAID, newest_first=True)) == seen[::-1]


def test_a_glance_at_a_chunk_that_says_to_be_larger_than_any_memory_gives_nothing(tmp_path: Path) -> None:
    path = log(tmp_path, NOW)
    data = bytearray(path.read_bytes())
    at = data.index(b"\x28\xb5\x2f\xfd") + 4  # behind zstd's magic: one byte says that the next eight are the content's size
    data[at : at + 9] = bytes([0xE0]) + (1 << 45).to_bytes(8, "little")
    path.write_bytes(data)
    assert list(glance(path, past.SAID)) == []


def test_samples_that_a_log_has_are_given_in_order_as_far_as_none_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "rig-20260101T000000Z.mcap"
    writer = Writer(path, run=path.stem, signer=KEY, timed=False)
    for index in (0, 1, 2, 4):
        writer.write(SampleTaken(1, 2, index, index, index, (0.0,), (0.0,), (0.0,), (), 1), 1)
    writer.write(SampleTaken(1, 1, 3, 3, 3, (0.0,), (0.0,), (0.0,), (), 1), 1)
    writer.close()
    assert [one.index for one in past.samples([path, tmp_path / "gone.mcap"], 2, [PUBLIC])] == [0, 1, 2]


def test_samples_count_only_from_what_this_robot_sealed(tmp_path: Path) -> None:
    """A gap rests on them: who can only write where the logs are must not be able to make some."""
    sample = SampleTaken(1, 2, 0, 0, 0, (0.0,), (0.0,), (0.0,), (), 1)
    for number, key in enumerate((None, OTHER, KEY)):
        path = tmp_path / f"{number}.mcap"
        writer = Writer(path, run=path.stem, signer=key, timed=False)
        writer.write(sample, 1)
        writer.durable()
        writer.write(msgspec.structs.replace(sample, index=1), 2)
        writer.close()
        assert len(past.samples([path], 2, [PUBLIC])) == (2 if key is KEY else 0)
    data = bytearray(path.read_bytes())
    data[data.index(b"zstd") + 40] ^= 1  # in the first chunk: nobody vouches for what follows
    path.write_bytes(data)
    assert past.samples([path], 2, [PUBLIC]) == []


def test_samples_are_looked_for_in_all_runs_since_their_campaign_began(tmp_path: Path) -> None:
    """However often the daemon started since, and did nothing."""
    under_way = changed(epochs=2, campaign_epoch=2, campaign_n=200)
    before = [log(tmp_path, NOW, stamp=f"2026010{day}T000000Z") for day in range(1, 6)]
    since = [log(tmp_path, under_way, stamp=f"2026020{day}T000000Z") for day in range(1, 6)]
    assert past.campaign_logs(past.Logs(tmp_path, "rig", [PUBLIC]), "rig", 2) == [*since[::-1], *before[:1:-1]]


# ---------------------------------------------------------------- in a running daemon


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    yield opened
    opened.close()


def put_back(rig: Rig, kept: Path, *names: str) -> None:
    for name in names:
        shutil.copy2(kept / name, rig.state / name)


@pytest.mark.slow
def test_an_old_copy_of_the_state_gives_back_no_attempt_no_revocation_and_no_stop(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until_status(gate="open")
    kept = rig.folder / "kept"
    kept.mkdir()
    shutil.copy2(rig.state / "state.json", kept)
    assert rig.ask("revoke")["exit_code"] == 0
    assert rig.ask("deploy", path=str(rig.controller("    raise ValueError('no')\n", "bad.py")))["exit_code"] == 1
    assert rig.ask("stop")["exit_code"] == 0
    before = rig.status()
    rig.kill()
    put_back(rig, kept, "state.json")
    rig.start()
    after = rig.status()
    known = ("attempts", "epoch", "revoked", "latched", "beta_spent", "certificate")
    assert {name: after[name] for name in known} == {name: before[name] for name in known}
    assert (after["gate"], after["attempts"], after["latched"]) == ("closed", 2, ["emergency_stop"])
    assert "going on from what" in rig.said()
    assert rig.stop() == 0

    file = rig.state / "state.json"
    memory = persistence.unseal(file.read_bytes(), "state", Memory, "state")
    persistence.replace(file, persistence.seal("state", msgspec.structs.replace(memory, attempts=0, epochs=memory.epochs + 1)))
    code, said = rig.refused()
    assert (code, "forgets epochs or attempts" in said) == (78, True), said
    persistence.replace(file, persistence.seal("state", memory))
    assert rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub")).returncode == 0
    assert rig.s2r("keys", "new", str(rig.state / "other.pem")).returncode == 0
    assert rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "other.pub")).returncode == 1


def test_a_log_of_a_key_that_was_rotated_still_counts_and_a_forged_one_stops_no_daemon(rig: Rig) -> None:
    """What was spent with the old key stays spent; and of two runs the later has the higher number, whatever its name says."""
    rig.start_robot()
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    kept = rig.folder / "kept"
    kept.mkdir()
    shutil.copy2(rig.state / "state.json", kept)
    assert rig.ask("undeploy")["exit_code"] == 0
    assert rig.ask("deploy", path=str(rig.controller("    raise ValueError('no')\n", "bad.py")))["exit_code"] == 1
    assert rig.stop() == 0
    (rig.logs / "rig-22000101T000000Z.mcap").write_bytes(
        forged(rig.folder, "this robot's public key", changed(latched=("x",))).read_bytes()
    )
    assert rig.s2r("keys", "rotate", str(rig.state / "key.pem")).returncode == 0
    put_back(rig, kept, "state.json")
    rig.start()
    status = rig.status()
    assert (status["attempts"], status["latched"]) == (2, [])
    assert "going on from what" in rig.said()
    assert "rig-22000101T000000Z.mcap; nothing that they hold counts" in rig.said()
    assert rig.stop() == 0
    own = [path for path in rig.log_files() if not path.name.startswith("rig-22")]
    assert [Reading(path).metadata["s2r"][past.NUMBER] for path in own] == ["1", "2"]


def interrupted(rig: Rig) -> tuple[Path, Path]:
    """A campaign that the daemon's end cuts off, and where an older copy of what was kept of it is; (that file, that folder)."""
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    file, kept = rig.state / "campaign.json", rig.folder / "kept"
    kept.mkdir()
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(rig.socket))
        client.sendall(b'{"verb": "sample", "count": 40}\n')  # so many that it is not over between two looks
        rig.until(lambda: file.exists() and b'"x0"' in file.read_bytes())
        shutil.copy2(file, kept)
        rig.until(lambda: (rig.status()["campaign"] or {}).get("taken", 0) >= 5)
    rig.stop()
    return file, kept


@pytest.mark.slow
@pytest.mark.parametrize("gone", [pytest.param(False, id="older"), pytest.param(True, id="deleted", marks=pytest.mark.slow)])
def test_samples_that_were_seen_are_not_drawn_once_more_by_putting_an_old_campaign_back(rig: Rig, gone: bool) -> None:
    rig.start_robot()
    rig.start()
    file, kept = interrupted(rig)
    seen = [m for m in rig.messages("event/sample_taken") if isinstance(m, SampleTaken)]
    file.unlink() if gone else put_back(rig, kept, "campaign.json")
    rig.start()
    assert rig.sample()["exit_code"] == 0
    rig.stop()
    samples = [m for m in rig.messages("event/sample_taken") if isinstance(m, SampleTaken)]
    again = [m for m in samples if m.again]
    assert [(m.index, m.x0, m.x1) for m in again] == [(m.index, m.x0, m.x1) for m in seen]
    assert len(samples) == len(seen) + len(again) + len([m for m in samples if m.index >= len(seen)])
    told = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert told["ok"], told


@pytest.mark.slow
def test_an_audit_tells_of_samples_that_were_drawn_again_where_the_daemon_could_not_know(rig: Rig) -> None:
    """The logs of before are somewhere else when the campaign goes on with an old copy of what was kept."""
    rig.start_robot()
    rig.start()
    interrupted(rig)
    put_back(rig, rig.folder / "kept", "campaign.json")
    before = [path.rename(rig.folder / path.name) for path in rig.log_files()]
    rig.start()
    assert rig.sample()["exit_code"] == 0
    rig.stop()
    told = json.loads(rig.s2r("audit", *map(str, (*before, *rig.log_files())), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert not told["ok"]
    assert "it drew some again" in told["first_difference"]["what"]


@pytest.mark.slow
@pytest.mark.parametrize("edit", ["added", "skipped"])
def test_an_edited_campaign_does_not_go_on(rig: Rig, edit: str) -> None:
    """Samples that nobody took would make a gap smaller; samples that are skipped would rest it on fewer."""
    rig.start_robot()
    rig.start()
    file, _ = interrupted(rig)
    content = persistence.unseal(file.read_bytes(), "campaign", dict[str, Any], str(file))
    kept = content["snapshot"]
    count = len(kept["samples"])
    if edit == "added":
        kept["samples"] += [{**kept["samples"][-1], "index": count + k} for k in range(3)]
    kept["campaign"]["index"] = count + 3
    persistence.replace(file, persistence.seal("campaign", content))
    rig.start()
    answer = rig.sample()
    says = {
        # a daemon that ends may have logged more than it stored: then an added sample stands where the log has another one
        "added": (f"has {count + 3} samples of epoch 1, its logs have", "of epoch 1 is not the one that was logged"),
        "skipped": (f"has {count} samples and goes on at {count + 3}",),
    }
    assert answer["exit_code"] != 0
    assert any(text in answer["text"] for text in says[edit]), answer["text"]
    assert rig.status()["gate"] != "open"
