"""Every transition of a robot's life: what it pays of the budget, what it voids, and that a restart right after it changes nothing.

The table in docs/guarantee.md is this one; a test compares them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from core_rig import GAP, Rig, kinds, memory, of, one, reason, reopen

from s2r_runtime.core import ledger
from s2r_runtime.core import reducer as core
from s2r_runtime.core.stream import BINS
from s2r_runtime.messages import (
    SERIAL,
    AlarmRaised,
    Answer,
    CampaignFinished,
    CertificateFacts,
    CertificateStored,
    ChangeNoticed,
    GateChanged,
    Measured,
    Memory,
    Persist,
    SampleTaken,
    StartCampaign,
    StartJob,
    WallClockRead,
)

GUARANTEE = Path(__file__).parent.parent / "docs" / "guarantee.md"


class Step(NamedTuple):
    """begin: to where the transition happens; act: what brings it about. Then what is paid, and what is left."""

    name: str
    begin: Callable[[Rig], object]
    act: Callable[[Rig], object]
    epochs: int = 0
    attempts: int = 0
    gap: bool = True
    certificates: int = 1


def nothing(rig: Rig) -> None:
    """The rig as it is."""


def interrupted(rig: Rig) -> None:
    rig.sampling()
    rig.request("stop")
    rig.request("clear", text="emergency_stop")


def dependent(rig: Rig) -> None:
    order = one(rig.sampling(), StartCampaign)
    rig.feed(CampaignFinished(rig.t, order.epoch, order.n, complete=True, rejected={}))
    found = msgspec.structs.replace(GAP, epoch=order.epoch, n=order.n, white=False, white_reason=f"{SERIAL} (p = 0.0005)")
    answer = one(rig.finish_gap(found), Answer)
    assert (answer.exit_code, "repeating is right" in answer.text) == (3, True)


def deploy(rig: Rig, digest: str, *, passed: bool) -> None:
    rig.request("deploy", digest=digest)
    rig.verified(passed=passed)
    if passed:
        rig.stored()


def outgrow(rig: Rig, *, passed: bool) -> None:
    assert one(rig.measure(0.02), GateChanged).reason == "radius_above_verified"
    rig.verified(passed=passed)
    if passed:
        rig.stored()
        reopen(rig)


def load(rig: Rig) -> None:
    facts = CertificateFacts("elsewhere", "other", "model", "task", "profile", 3, 0.01, 0.015, 1500, 2500, 4)
    found = msgspec.structs.replace(GAP, epoch=3, n=400, transitions_digest="another campaign")
    rig.feed(CertificateStored(rig.t, facts, gap=found, request_id=9))


def restart(rig: Rig) -> None:
    again = Rig(of(rig.outputs, Persist)[-1].memory)
    rig.state, rig.outputs = again.state, rig.outputs + again.outputs


def with_profile(rig: Rig) -> None:
    again = Rig(of(rig.outputs, Persist)[-1].memory, campaign_digest="another norm")
    rig.state, rig.settings, rig.outputs = again.state, again.settings, rig.outputs + again.outputs


STEPS = [
    Step("campaign begun", Rig.driving, lambda rig: (rig.request("undeploy"), rig.sampling()), epochs=1),
    Step("campaign interrupted and resumed", lambda rig: (rig.gap(), interrupted(rig)), lambda rig: rig.sampling(), certificates=0),
    Step("campaign cancelled", lambda rig: (rig.gap(), rig.sampling()), lambda rig: rig.request("cancel"), certificates=0),
    Step("campaign refused, its samples depend on each other", Rig.gap, dependent, epochs=1, certificates=0),
    Step("gap in force", lambda rig: (rig.driving(), rig.request("undeploy")), Rig.gap, epochs=1, certificates=0),
    Step("verification attempt, passed", Rig.gap, lambda rig: deploy(rig, "controller", passed=True), attempts=1),
    Step("verification attempt, failed", Rig.gap, lambda rig: deploy(rig, "controller", passed=False), attempts=1, certificates=0),
    Step(
        "new controller",
        lambda rig: (rig.driving(), rig.request("undeploy")),
        lambda rig: deploy(rig, "another", passed=True),
        attempts=1,
        certificates=2,
    ),
    Step(
        "controller with a valid certificate deployed again",
        lambda rig: (rig.driving(), rig.request("undeploy")),
        lambda rig: rig.request("deploy", digest="controller"),
    ),
    Step("growth within the verified radius", Rig.driving, lambda rig: rig.measure(0.014)),
    Step("growth beyond it, passed", Rig.driving, lambda rig: outgrow(rig, passed=True), attempts=1),
    Step("growth beyond it, failed", Rig.driving, lambda rig: outgrow(rig, passed=False), attempts=1, certificates=0),
    Step("alarm", Rig.driving, lambda rig: rig.measure(0.001, e_value=1e3), gap=False, certificates=0),
    Step("notice of change", Rig.driving, lambda rig: rig.measure(0.001, change=2e5)),
    Step(
        "model adopted",
        lambda rig: (rig.driving(), rig.request("undeploy")),
        lambda rig: rig.request("adopt", digest="better"),
        gap=False,
        certificates=0,
    ),
    Step("certificate expired", Rig.driving, lambda rig: rig.feed(WallClockRead(rig.t, 9000))),
    Step("certificate revoked by a person", Rig.driving, lambda rig: rig.request("revoke", text="c1"), certificates=0),
    Step("certificate of a later epoch loaded", lambda rig: (rig.driving(), rig.request("undeploy")), load, epochs=2, attempts=3),
    Step("restart", Rig.driving, restart),
    Step("restart with another profile", Rig.driving, with_profile, gap=False, certificates=0),
]


@pytest.mark.parametrize("step", STEPS, ids=[step.name for step in STEPS])
def test_a_transition_pays_voids_and_persists_what_the_table_says(step: Step) -> None:
    rig = Rig()
    step.begin(rig)
    before = rig.state.memory
    step.act(rig)
    found = rig.state.memory
    assert (found.epochs - before.epochs, found.attempts - before.attempts) == (step.epochs, step.attempts)
    assert len(found.certificates) == step.certificates
    status = core.status(rig.state)
    usable = found.gap is not None and not status["alarm"]
    assert usable == step.gap
    assert status["beta_spent"] == pytest.approx(ledger.spent(0.05, found.epochs, found.attempts))
    assert status["beta_left"] == pytest.approx(0.05 - status["beta_spent"])
    kept = of(rig.outputs, Persist)[-1].memory
    unsaved = {"watch_n", "watch_exceedances", "watch_e_value", "watch_change", "watch_exchange", "watch_counts"}
    for name in Memory.__struct_fields__:
        if name not in unsaved:
            assert getattr(kept, name) == getattr(found, name), name
    again = Rig(kept, campaign_digest=rig.settings.campaign_digest, model_digest=found.model_digest)
    for key in ("epoch", "attempts", "beta_spent", "radius", "alarm", "unfinished_epoch", "samples_to_certificate"):
        if key != "samples_to_certificate" or status["campaign"] is None:
            assert core.status(again.state)[key] == status[key], key


def test_the_table_of_the_docs_is_this_one() -> None:
    rows = [line.split("|")[1].strip() for line in GUARANTEE.read_text(encoding="utf-8").splitlines() if re.match(r"\| [a-z]", line)]
    assert [step.name for step in STEPS if step.name not in rows] == []


# ---------------------------------------------------------------- what the watch has seen


def test_a_gap_in_force_begins_the_watch_anew_and_a_restart_goes_on_with_it() -> None:
    rig = Rig(memory(watch_change=7.0, watch_exchange=3.0, watch_counts=(1,) * BINS))
    status = core.status(rig.state)["stream"]
    assert isinstance(status, dict)
    assert (status["n"], status["exceedances"], status["change"], status["exchange"]) == (7, 1, 7.0, 3.0)
    rig.gap()
    kept = of(rig.outputs, Persist)[-1].memory
    assert (kept.watch_n, kept.watch_e_value, kept.watch_change, kept.watch_exchange, kept.watch_counts) == (0, 1.0, 0.0, 1.0, ())


def test_evidence_is_written_as_soon_as_it_has_doubled_so_that_a_kill_forgets_less_than_that() -> None:
    rig = Rig()
    rig.driving()
    written = []
    for step in range(60):
        e_value = 1.15**step * 0.5
        if e_value >= 100.0:
            break
        outputs = rig.measure(0.001, e_value=e_value)
        written += [p.memory.watch_e_value for p in of(outputs, Persist)]
        kept = of(rig.outputs, Persist)[-1].memory
        assert e_value < 2.0 * max(1.0, kept.watch_e_value)
    assert len(written) <= 7
    assert rig.measure(0.001, e_value=0.5) == []
    assert of(rig.measure(0.02), Persist)  # written with what is remembered next, whatever it is
    assert of(rig.outputs, Persist)[-1].memory.watch_e_value == 1.0


def test_discrepancies_are_counted_by_bin_and_rejected_ones_are_not() -> None:
    rig = Rig()
    rig.driving()
    for d in (0.0, 0.001, 0.009, 0.0101):
        rig.measure(d)
    rig.measure(5.0, fault="jump")
    counts = rig.state.memory.watch_counts
    assert (len(counts), sum(counts), counts[0], counts[17]) == (BINS, 4, 1, 1)


# ---------------------------------------------------------------- notices


def test_a_notice_of_change_is_recorded_each_time_and_revokes_nothing() -> None:
    rig = Rig()
    rig.driving()
    assert rig.measure(0.001, change=99_999.0) == []
    for value in (1.0e5, 3e5):
        notice = one(rig.measure(0.001, change=value), ChangeNoticed)
        assert notice == ChangeNoticed(rig.t, "change", value, 1e5, 1, rig.seq)
    assert rig.state.gate_open
    assert core.status(rig.state)["certificate"] == "c1"


def test_that_the_stream_is_not_of_one_law_is_said_once() -> None:
    rig = Rig()
    rig.driving()
    assert kinds(rig.measure(0.001, exchange=99.0)) == []
    assert one(rig.measure(0.001, exchange=101.0), ChangeNoticed).kind == "exchangeability"
    assert rig.measure(0.001, exchange=101.0) == []
    assert rig.state.gate_open


def test_a_notice_of_change_is_a_reason_to_trace_where_growth_is() -> None:
    rig = Rig(trace_on_growth=True, trace_delay_ns=0)
    rig.driving()
    assert of(rig.measure(0.001, exchange=1e3), StartJob) == []
    assert one(rig.measure(0.001, change=1e6), StartJob).kind == "trace"
    rig = Rig()
    rig.driving()
    assert of(rig.measure(0.001, change=1e6), StartJob) == []


@pytest.mark.parametrize(
    "broken", [{"change": math.nan}, {"exchange": math.inf}, {"change": -1.0}, {"e_value": math.nan}, {"e_value": -1.0}]
)
def test_evidence_that_is_no_number_is_a_fault_of_measurement_and_its_discrepancy_counts_all_the_same(broken: dict[str, float]) -> None:
    rig = Rig()
    rig.driving()
    n = rig.state.measured
    outputs = rig.measure(0.5, **broken)
    assert (rig.state.faults, rig.state.memory.radius, rig.state.measured, rig.state.e_value) == (1, 0.5, n, 1.0)
    assert not rig.state.gate_open
    assert of(outputs, ChangeNoticed) == of(outputs, AlarmRaised) == []


def test_a_discrepancy_that_is_no_number_or_was_rejected_moves_nothing_but_the_count_of_faults() -> None:
    rig = Rig()
    rig.driving()
    for count, wrong in enumerate(({"discrepancy": math.nan}, {"discrepancy": -0.5}, {"discrepancy": 0.5, "fault": "jump"}), 1):
        outputs = rig.measure(**{"discrepancy": 0.001, "e_value": 1e9, **wrong})  # type: ignore[arg-type]
        assert (rig.state.faults, rig.state.memory.radius, rig.state.memory.alarm_epoch) == (count, 0.01, 0)
        assert of(outputs, AlarmRaised) == []
    assert reason(rig) == "measurement_faults" or rig.state.faults <= rig.settings.max_measurement_faults


# ---------------------------------------------------------------- status


def test_status_says_how_many_samples_are_lacking_at_every_point_of_a_life() -> None:
    rig = Rig()

    def lacking() -> object:
        return core.status(rig.state)["samples_to_certificate"]

    needed = ledger.campaign_size(0.03, ledger.share(0.05, 1), 0)
    assert lacking() == needed
    n = one(rig.sampling(), StartCampaign).n
    rig.feed(SampleTaken(rig.t, 1, 41, 1, 1, (0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (), 1))
    assert (n, lacking()) == (needed, needed - 42)
    rig.request("cancel")
    assert lacking() == ledger.campaign_size(0.03, ledger.share(0.05, 2), 0)
    rig.gap()
    assert lacking() == 0
    rig.measure(0.001, e_value=1e3)
    assert lacking() == ledger.campaign_size(0.03, ledger.share(0.05, 3), 0)
    assert core.status(core.initial())["samples_to_certificate"] is None
    assert core.status(Rig(epsilon=1e-12).state)["samples_to_certificate"] is None
    assert core.status(Rig(campaign_n=5000).state)["samples_to_certificate"] == 5000


def test_status_says_how_much_of_the_headroom_is_used_and_what_driving_shows() -> None:
    rig = Rig()
    assert core.status(rig.state)["stream"] is None
    assert core.status(rig.state)["headroom_used"] is None
    rig.driving()
    assert core.status(rig.state)["headroom_used"] == pytest.approx(0.01 / 0.015)
    rig.measure(0.012)
    assert core.status(rig.state)["headroom_used"] == pytest.approx(0.012 / 0.015)
    for n in range(1, 1001):
        rig.feed(Measured(rig.t, rig.seq, 0.004 if n % 10 else 0.008, "", 1.0, n, 1, 1))
    found = core.status(rig.state)["stream"]
    assert isinstance(found, dict)
    assert found["exceedance_upper"] < 0.03  # one of 1001
    assert found["quantile"] == pytest.approx(0.01 * 13 / 16)  # 0.008 lies in the thirteenth bin
    assert (found["epsilon"], found["alarm_at"], found["change_at"]) == (0.03, 100.0, 1e5)
    msgspec.json.encode(core.status(rig.state))
