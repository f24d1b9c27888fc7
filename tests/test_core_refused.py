"""A campaign whose samples depend on each other is no dead end: it is remembered, can be traced and repeated, and says what that costs."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from core_rig import GAP, Rig, answers, of, one
from report_rig import Answered

from s2r_runtime.core import ledger
from s2r_runtime.core import reducer as core
from s2r_runtime.core.gaps import GOOD_REFUSED
from s2r_runtime.evidence.whiteness import SERIAL_ALPHA
from s2r_runtime.messages import (
    REPEATED,
    RULES,
    SERIAL,
    Answer,
    CampaignFinished,
    JobFinished,
    Persist,
    SourceStarted,
    StartCampaign,
    StartJob,
)

WHY = f"{SERIAL} (p = 0.002)"


def campaign(rig: Rig, **fields: Any) -> StartCampaign:
    """A campaign is begun."""
    rig.observe()
    rig.request("permit", duration_s=60.0)
    order = one(rig.request("sample", **fields), StartCampaign)
    rig.feed(SourceStarted(rig.t, "sampler", "settings"))
    return order


def ends(rig: Rig, order: StartCampaign, white_reason: str = WHY) -> list[Any]:
    """It is complete, and its gap is computed."""
    rig.feed(CampaignFinished(rig.t, order.epoch, order.n, complete=True, rejected={}))
    digest = f"transitions-{order.epoch}"
    return rig.finish_gap(msgspec.structs.replace(GAP, epoch=order.epoch, n=order.n, transitions_digest=digest, white_reason=white_reason))


def test_the_level_that_is_said_is_the_tests_own() -> None:
    assert GOOD_REFUSED * SERIAL_ALPHA == 1.0


def test_a_refusal_says_what_it_means_what_it_cost_and_what_to_do() -> None:
    rig = Rig(rules=RULES)
    order = campaign(rig)
    outputs = ends(rig, order)
    kept = one(outputs, Persist).memory.refused_campaign
    assert kept is not None
    assert (kept.epoch, kept.n, kept.beta, kept.reason, kept.in_a_row) == (1, 161, ledger.share(0.05, 1), WHY, 1)
    said = one(outputs, Answer)
    assert (said.exit_code, said.final) == (3, True)
    for part in ("at most 1 in 200 good campaigns", "repeating is right: s2r sample PROFILE --retry", "epoch 2 takes 206 samples",
                 "spends 0.0038", "battery", "s2r trace --live campaign"):  # fmt: skip
        assert part in said.text, part
    again = ends(rig, campaign(rig))
    assert "2 in a row are hardly chance" in one(again, Answer).text
    found = core.status(rig.state)
    assert found["refused_campaign"] == {"epoch": 2, "n": 206, "beta": ledger.share(0.05, 2), "reason": WHY, "in_a_row": 2}
    assert found["next_campaign"] == {"epoch": 3, "beta": ledger.share(0.05, 3), "n": ledger.campaign_size(0.03, ledger.share(0.05, 3), 0)}
    ends(rig, campaign(rig), "")
    assert rig.state.memory.gap is not None
    assert rig.state.memory.refused_campaign is None


def test_retry_repeats_once_in_the_next_epoch_and_answers_once() -> None:
    rig = Rig(rules=RULES)
    order = campaign(rig, text="retry")
    number = rig.requests
    outputs = ends(rig, order)
    again = one(outputs, StartCampaign)
    assert (again.epoch, again.resume, again.n) == (2, False, 206)
    assert "it is repeated now (epoch 2 takes 206 samples and spends 0.0038)" in one(outputs, Answer).text
    assert not answers(rig)[number]
    rig.feed(SourceStarted(rig.t, "sampler", "settings"))
    assert not of(ends(rig, again), StartCampaign), "a second refusal is no chance"
    assert [a.exit_code for a in answers(rig)[number]] == [3]


def test_samples_that_repeat_each_other_are_not_taken_again_by_themselves() -> None:
    rig = Rig(rules=RULES)
    order = campaign(rig, text="retry")
    outputs = ends(rig, order, f"{REPEATED} more often than independent ones do (p = 0.0005): 9 of 206 are copies of others")
    assert not of(outputs, StartCampaign)
    said = one(outputs, Answer)
    assert said.exit_code == 3
    assert "9 of 206 are copies" in said.text
    assert "plays a recording instead of the robot" in said.text
    assert rig.state.memory.gap is None


def test_retry_does_not_drive_without_a_permit() -> None:
    rig = Rig(rules=RULES)
    order = campaign(rig, text="retry")
    rig.feed(CampaignFinished(rig.t, 1, order.n, complete=True, rejected={}))
    rig.request("permit", duration_s=0.0)
    outputs = rig.finish_gap(msgspec.structs.replace(GAP, n=order.n, white_reason=WHY))
    assert not of(outputs, StartCampaign)
    assert one(outputs, Answer).text.endswith("Not repeated: no_permit.")


@pytest.mark.parametrize("rules", [0, RULES])
def test_a_refused_campaign_can_be_traced(rules: int) -> None:
    rig = Rig(rules=rules)
    ends(rig, campaign(rig))
    outputs = rig.request("trace", text="campaign")
    if not rules:  # as the version before
        assert one(outputs, Answer).exit_code == 3
        assert rig.state.memory.refused_campaign is None
        return
    order = one(outputs, StartJob)
    assert (order.kind, order.stretch, order.epoch) == ("trace", "campaign", 1)
    done = rig.feed(JobFinished(rig.t, order.job_id, "trace", trace={"verdict": "none"}))
    assert one(done, Answer).text == "trace of the refused campaign of epoch 1: none"


def test_the_report_marks_a_refused_campaign_and_what_it_cost() -> None:
    from types import SimpleNamespace

    from s2r_runtime.report.page import Page
    from s2r_runtime.report.run_page import add_refused
    from s2r_runtime.report.story import tell

    rig = Answered(rules=RULES)
    ends(rig, campaign(rig))
    story = tell(SimpleNamespace(message=message) for message in rig.log)
    assert [what for _, what, kind in story.marks if kind == "bad"] == ["campaign of epoch 1 refused: its samples depend on each other"]
    page = Page("t", "")
    add_refused(page, story, {})
    for part in ("Refused campaign of epoch 1", "161", "0.0152", "p = 0.002", "1 in 200"):
        assert part in page.html(), part
