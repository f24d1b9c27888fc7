"""Certificates that a person brings, made elsewhere, with the gap that they rest on."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from core_rig import GAP, Rig, kinds, memory, of, one
from loaded_rig import loaded

from s2r_runtime.core.gaps import REFUTED
from s2r_runtime.messages import (
    Answer,
    CertificateInstalled,
    CertificateStored,
    Memory,
    StartController,
)


def test_a_loaded_certificate_brings_its_gap_if_it_founds_a_later_epoch() -> None:
    rig = Rig()
    outputs = rig.feed(loaded(4))
    assert kinds(outputs) == ["Persist", "EpochChanged", "CertificateInstalled", "Persist", "Answer"]
    assert (rig.state.memory.epochs, rig.state.memory.attempts) == (4, 7)
    assert one(rig.request("deploy", digest="controller"), StartController).certificate_id == "offline"


def test_a_loaded_certificate_on_the_gap_in_force_is_installed_beside_it() -> None:
    rig = Rig(memory())
    rig.feed(loaded())
    assert [facts.id for facts in rig.state.memory.certificates] == ["offline"]  # it reaches farther
    rig = Rig(memory())
    rig.feed(loaded(verified_radius=0.012))
    assert [facts.id for facts in rig.state.memory.certificates] == ["c1", "offline"]


def test_a_second_certificate_under_the_id_of_one_in_force_changes_nothing() -> None:
    """An id is the digest of the content, so one of the two is false; the driving controller keeps what it had."""
    rig = Rig(memory())
    rig.observe()
    rig.request("deploy", digest="controller")
    for change in ({"controller_digest": "another"}, {"verified_radius": 1e-5}, {"expires_unix_s": 9000}):
        before = rig.state.memory
        event = loaded(id="c1", **{"verified_radius": 0.015, "attempt": 1, **change})
        outputs = rig.feed(msgspec.structs.replace(event, t_ns=rig.t))
        assert kinds(outputs) == ["Answer"]
        assert "another certificate in force has its id" in one(outputs, Answer).text
        assert rig.state.memory == before


def of_another_norm(**norm: Any) -> CertificateStored:
    event = loaded(2)
    assert event.gap is not None
    return msgspec.structs.replace(event, gap=msgspec.structs.replace(event.gap, **norm))


@pytest.mark.parametrize(
    ("event", "kept", "word"),
    [
        (loaded(1, "others"), memory(), "epoch 1"),
        (loaded(), memory(alarm_epoch=1), "refuted"),
        (loaded(2, model_digest="another"), memory(), "another epoch or model"),
        (loaded(2, task_digest="another"), memory(), "task"),
        (loaded(profile_digest="another"), memory(), "profile"),
        (loaded(2, profile_digest="of another robot"), memory(), "profile"),
        (loaded(2, verified_radius=math.nan), memory(), "verified to nan"),
        (loaded(2), memory(certificates=(), revoked={"offline": "by_operator"}), "revoked"),
        (of_another_norm(weights=(1e-6, 1e-6, 1e-6), radius=1e-9, hold_radius=5e-8), memory(), "norm"),
        (of_another_norm(weights=(1.0, 1.0)), memory(), "norm"),
        (of_another_norm(set="box"), memory(), "norm"),
        (loaded(2, "transitions"), memory(), "samples of epoch 1"),
        (loaded(2, "transitions"), memory(radius=0.014), "samples of epoch 1"),
        (loaded(2, "transitions"), memory(alarm_epoch=1), "samples of epoch 1"),
        (loaded(2), memory(refuted=("transitions-0", "transitions-2")), "refuted"),
        (loaded(), memory(certificates=(), revoked={"offline": "by_operator"}), "revoked"),
        (msgspec.structs.replace(loaded(3), gap=msgspec.structs.replace(GAP, epoch=3, n=99)), memory(), "too few"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_loaded_certificate_that_does_not_fit_is_refused(event: CertificateStored, kept: Memory, word: str) -> None:
    rig = Rig(kept)
    outputs = rig.feed(event)
    assert of(outputs, CertificateInstalled) == []
    assert word in one(outputs, Answer).text
    assert not one(outputs, Answer).final
    assert kinds(outputs) == ["Answer"]
    assert rig.state.memory == kept  # gap, grown radius, epochs, certificates, and what is revoked


def _refuted_by_the_watch(rig: Rig) -> None:
    rig.measure(0.001, e_value=1e3, epoch=1)


def _outgrown(rig: Rig) -> None:
    rig.measure(0.014, epoch=1)


@pytest.mark.parametrize("seen", [_refuted_by_the_watch, _outgrown])
def test_samples_that_were_seen_not_to_hold_found_no_later_epoch_however_many_came_since(seen: Callable[[Rig], None]) -> None:
    rig = Rig(memory())
    seen(rig)
    rig.feed(loaded(2, id="second"))
    assert rig.state.memory.gap is not None
    assert rig.state.memory.gap.epoch == 2
    rig = Rig(msgspec.json.decode(msgspec.json.encode(rig.state.memory), type=Memory))  # what a restart remembers
    before = rig.state.memory
    assert "refuted or outgrown" in one(rig.feed(loaded(3, "transitions")), Answer).text
    assert rig.state.memory == before
    assert of(rig.feed(loaded(3)), CertificateInstalled)


def test_the_samples_of_a_refuted_gap_are_remembered_with_its_alarm_when_the_profile_changes() -> None:
    rig = Rig(memory())
    _refuted_by_the_watch(rig)
    assert rig.state.memory.refuted == ("transitions",)
    rig = Rig(rig.state.memory, campaign_digest="another profile's")
    assert rig.state.memory.gap is None
    assert "refuted or outgrown" in one(rig.feed(loaded(2, "transitions")), Answer).text


def test_what_is_remembered_of_refuted_gaps_is_bounded_and_the_newest() -> None:
    rig = Rig(memory(refuted=tuple(f"old-{i}" for i in range(REFUTED))))
    _refuted_by_the_watch(rig)
    assert rig.state.memory.refuted == (*(f"old-{i}" for i in range(1, REFUTED)), "transitions")


def test_a_gap_that_held_makes_way_and_its_samples_are_no_worse_for_it() -> None:
    rig = Rig(memory())
    rig.feed(loaded(2))
    assert rig.state.memory.refuted == ()


def test_a_loaded_gap_does_not_come_between_a_campaign() -> None:
    rig = Rig()
    rig.sampling()
    assert "under way" in one(rig.feed(msgspec.structs.replace(loaded(2), t_ns=rig.t)), Answer).text
