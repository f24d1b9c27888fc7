"""Certificates that a person brings, made elsewhere, with the gap that they rest on."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from core_rig import GAP, Rig, S, kinds, memory, of, one

from s2r_runtime.core import ledger
from s2r_runtime.messages import (
    Answer,
    CertificateFacts,
    CertificateInstalled,
    CertificateStored,
    Memory,
    StartController,
)


def loaded(epoch: int = 1, transitions: str = "transitions", **changes: Any) -> CertificateStored:
    facts = CertificateFacts("offline", "controller", "model", "task", "profile", epoch, 0.01, 0.02, 1500, 2500, 7)
    gap = msgspec.structs.replace(
        GAP, epoch=epoch, transitions_digest=transitions, n=ledger.campaign_size(0.03, ledger.share(0.05, epoch), 0)
    )
    return CertificateStored(S, msgspec.structs.replace(facts, **changes), gap, 5)


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


@pytest.mark.parametrize(
    ("event", "kept", "word"),
    [
        (loaded(1, "others"), memory(), "epoch 1"),
        (loaded(), memory(alarm_epoch=1), "refuted"),
        (loaded(2, model_digest="another"), memory(), "another epoch or model"),
        (loaded(2, task_digest="another"), memory(), "task"),
        (loaded(profile_digest="another"), memory(), "profile"),
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


def test_a_loaded_gap_does_not_come_between_a_campaign() -> None:
    rig = Rig()
    rig.sampling()
    assert "under way" in one(rig.feed(msgspec.structs.replace(loaded(2), t_ns=rig.t)), Answer).text
