"""A log whose records fit together, whose robot did what is written, and whose liar signs with the right key, does not pass if what was
concluded is wrong: evidence that carries no certificate, a budget overspent, a gate that opened for no reason, a memory that forgets.

These liars run a core (or a campaign, or a worker) of their own making. What they log is what it really did.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import audit_bench
import msgspec
import pytest
from audit_bench import KEY, PUBLIC, Bench

from s2r_runtime import gate
from s2r_runtime import messages as m
from s2r_runtime.audit.log import AuditResult, audit
from s2r_runtime.core import certificates, gaps, ledger, sources
from s2r_runtime.daemon import jobs
from s2r_runtime.daemon.worker import GapJob, VerifyJob
from s2r_runtime.plugins import registry

DAY_S = 86_400


def clock(bench: Any, unix_s: int) -> None:
    """The daemon reads the wall clock."""
    bench.feed(m.WallClockRead(0, unix_s))


def whole(bench: Any) -> Any:
    """A campaign, its gap, a certificate, a drive."""
    return bench.sample().drive(40).stop()


def sampled(bench: Any) -> Any:
    """A campaign and its gap."""
    return bench.sample().stop()


def runaway(bench: Any) -> Any:
    """The robot comes to go three times as fast as it should."""
    bench.sample().drive(20)
    bench.gain = 3.0
    bench.steps(150)
    return bench.stop()


def outlived(bench: Any) -> Any:
    """The certificate expires while the controller drives."""
    bench.sample().drive(20)
    clock(bench, audit_bench.START_UNIX_S + 2 * DAY_S)
    bench.steps(20)
    return bench.stop()


def unpermitted(bench: Any) -> Any:
    """The permit ends during the campaign."""
    bench.step()
    bench.ask("permit", duration_s=0.3)
    bench.ask("sample")
    while bench.state.memory.gap is None and bench.seq < 3000:
        bench.step()
    return bench.stop()


def strayed(bench: Any) -> Any:
    """The robot is carried out of the region, and the controller goes on."""
    bench.sample().drive(20)
    bench.x = [5.0, 5.0, 0.0]
    bench.steps(20)
    return bench.stop()


def withdrawn(bench: Any) -> Any:
    """A person revokes the certificate that the controller drives under."""
    bench.sample().drive(20)
    bench.ask("revoke", text=bench.state.memory.certificates[-1].id)
    bench.steps(20)
    return bench.stop()


def stopped(bench: Any) -> Any:
    """A person presses the button."""
    bench.sample().drive(20)
    bench.ask("stop")
    bench.steps(20)
    return bench.stop()


def without(name: str) -> Callable[..., Any]:
    """The gate, but for one reason."""
    honest = gate.about_certificate

    def about(settings: Any, s: Any) -> Any:
        found = honest(settings, s)
        return None if found is not None and found.reason == name else found

    return about


def narrow(_turn: Any, gap: m.Gap) -> tuple[float, float, float]:
    """The gap itself, no headroom."""
    return gap.radius, gap.radius, gap.hold_radius


def failing(bench_verify: Any) -> Any:
    """Scenarios of which some are unsafe, and a verdict that says so."""

    def verify(self: Any, order: Any) -> Any:
        event = bench_verify(self, order)
        worst = {law: [-0.4, *values[1:]] for law, values in event.safety.items()}
        laws = tuple(
            msgspec.structs.replace(
                law,
                s_star=-0.4,
                failures=1,
                passed=False,
                failure_upper=audit_bench.clopper_pearson_upper(1, law.n, order.beta / event.verification.split),
            )
            for law in event.verification.laws
        )
        found = msgspec.structs.replace(event.verification, laws=laws, passed=False, reason="the law uniform did not pass", tried=())
        return msgspec.structs.replace(event, verification=found, safety=worst)

    return verify


def nothing(*_: Any) -> None:
    """No reason against it; nothing to do."""


Lie = tuple[Any, str, Any, Callable[[Any], Any], str]
CORES: dict[str, Lie] = {  # the module and function that the liar replaces, by what; the story; what an honest core says there
    "an expired certificate is used": (gate, "about_certificate", without("certificate_expired"), outlived, "certificate_expired"),
    "a revoked certificate is used": (gate, "about_certificate", without("certificate_revoked"), withdrawn, "certificate_revoked"),
    "a gap above what was verified is driven on": (
        gate,
        "about_certificate",
        without("radius_above_verified"),
        runaway,
        "radius_above_verified",
    ),
    "the gate stays open outside the region": (gate, "_about_observation", nothing, strayed, "outside_region"),
    "the gate opens although a stop latches": (gate, "_about_controller", nothing, stopped, "no_controller"),
    "the sampler drives without a permit": (gate, "_about_sampler", nothing, unpermitted, '"source":"recovery"'),
    "a watch alarm goes unheeded": (gaps, "_alarm", nothing, runaway, "alarm_raised"),
    "a growing gap goes unheeded": (gaps, "measured", nothing, runaway, "radius_above_verified"),  # it grows beyond that at once
    "more of beta is spent than there is": (ledger, "share", lambda beta, number: beta / (3.0 * number) ** 2, sampled, '"attempts":0'),
    "the seed of the scenarios is chosen": (ledger, "seed", lambda *parts: 4711 + len(parts), whole, "start_campaign"),
    "less headroom is verified than was ordered": (certificates, "_radii", narrow, whole, "attempt_spent"),
    "a campaign goes on where it may not": (sources, "check_campaign", nothing, unpermitted, '"source":"recovery"'),
}


@pytest.mark.slow
@pytest.mark.parametrize("lie", CORES)
def test_what_another_core_concluded_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lie: str) -> None:
    module, name, instead, story, said = CORES[lie]
    with monkeypatch.context() as patched:
        patched.setattr(module, name, instead)
        bench = story(Bench(tmp_path))
    honest = story(Bench(tmp_path))
    assert bench.items != honest.items, "the liar's core did nothing of its own"
    result = audit([bench.write(tmp_path / "lie.mcap")], PUBLIC)
    assert not result.ok
    assert result.chain == "intact", "the liar has the key"
    assert result.first_difference is not None
    assert said in result.first_difference.recomputed
    told = audit([honest.write(tmp_path / "honest.mcap")], PUBLIC)
    assert told.ok, told.text()


def test_a_controller_that_failed_gets_no_certificate_whatever_its_core_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(audit_bench.Bench, "_verify", failing(audit_bench.Bench._verify))
        patched.setattr(certificates, "_result_problem", lambda *_: "")
        patched.setattr(audit_bench.certificates, "issue", lenient(audit_bench.certificates.issue))
        bench = whole(Bench(tmp_path))
    assert any(isinstance(item, m.CertificateStored) for item in bench.items)
    result = audit([bench.write(tmp_path / "a.mcap")], PUBLIC)
    assert not result.ok
    assert not any(one.valid for one in result.certificates)


def lenient(issue: Any) -> Any:
    """Writes a certificate, whatever the verification says."""

    def write(**given: Any) -> Any:
        honest = given["verification"]
        good = msgspec.structs.replace(
            honest,
            passed=True,
            reason="",
            laws=tuple(msgspec.structs.replace(law, passed=True, s_star=0.5, failures=0) for law in honest.laws),
        )
        made = issue(**{**given, "verification": good})
        return msgspec.structs.replace(made, verification=honest)

    return write


# ---------------------------------------------------------------- what a worker or a campaign says

GAP_LIES: dict[str, Callable[[m.Gap], m.Gap]] = {
    "the radius is too small": lambda g: msgspec.structs.replace(g, radius=0.99 * g.radius),
    "the hold radius is too small": lambda g: msgspec.structs.replace(g, hold_radius=0.5 * g.hold_radius),
    "more samples than there are": lambda g: msgspec.structs.replace(g, n=g.n + 1),
    "one was discarded, and not said": lambda g: msgspec.structs.replace(g, radius=0.97 * g.radius, discarded=0),
    "a smaller epsilon": lambda g: msgspec.structs.replace(g, epsilon=0.5 * g.epsilon),
    "a smaller beta": lambda g: msgspec.structs.replace(g, beta=0.1 * g.beta),
    "the norm was chosen afterwards": lambda g: msgspec.structs.replace(g, weights=(1.0, 0.1, 0.05), radius=0.5 * g.radius),
    "other transitions": lambda g: msgspec.structs.replace(g, transitions_digest="sha256:" + "0" * 64),
    "white, although it is not": lambda g: msgspec.structs.replace(g, white=not g.white, white_reason=""),
}


@pytest.mark.parametrize("lie", GAP_LIES)
def test_a_gap_that_its_samples_do_not_have_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lie: str) -> None:
    honest = jobs.gap

    def told(job: GapJob) -> m.Gap:
        return GAP_LIES[lie](honest(job))

    with monkeypatch.context() as patched:
        patched.setattr(gaps, "_gap_problem", lambda *_: "")
        patched.setattr(certificates, "_result_problem", lambda *_: "")
        patched.setattr(audit_bench.jobs, "gap", told)
        bench = sampled(Bench(tmp_path))
    result = audit([bench.write(tmp_path / "a.mcap")], PUBLIC)
    assert not result.ok
    if lie == "more samples than there are":
        assert result.unchecked == ["gap of epoch 1: 14 of its 15 samples are in the logs given"]
        return
    assert result.first_difference is not None
    assert "the gap of epoch 1" in result.first_difference.what


def test_samples_that_were_dropped_from_a_campaign_are_missed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The worst one is not logged; the campaign takes one more instead."""
    bench = Bench(tmp_path)
    honest, dropped = bench._sampler, []

    def sampler(ask: Any) -> Any:
        before = bench.campaign.snapshot() if bench.campaign is not None else None
        events = honest(ask)
        taken = next((one for one in events if isinstance(one, m.SampleTaken)), None)
        if taken is not None and len(bench.samples) == 5 and not dropped:
            dropped.append(taken)
            bench.samples.pop()
            assert before is not None
            bench.campaign.restore({**bench.campaign.snapshot(), "index": before["index"]})
            return [one for one in events if one is not taken]
        return events

    monkeypatch.setattr(bench, "_sampler", sampler)
    whole(bench)
    assert dropped
    assert len(bench.samples) == 14
    result = audit([bench.write(tmp_path / "a.mcap")], PUBLIC)
    assert not result.ok
    assert result.first_difference is not None
    assert "the campaign gives something else here" in result.first_difference.what


@pytest.mark.parametrize("field", ["fault", "e_value", "exceedances", "exchange", "change", "n"])
def test_a_watch_that_says_less_than_the_stream_shows_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: str) -> None:
    bench = Bench(tmp_path)
    lies = {"fault": "jump", "e_value": 1.0, "exceedances": 0, "exchange": 0.5, "change": 0.0, "n": 1}

    def calm(*events: Any) -> None:
        Bench.feed(bench, *(msgspec.structs.replace(e, **{field: lies[field]}) if isinstance(e, m.Measured) else e for e in events))

    monkeypatch.setattr(bench, "feed", calm)
    runaway(bench)
    result = audit([bench.write(tmp_path / "a.mcap")], PUBLIC)
    assert not result.ok
    assert result.first_difference is not None
    assert "the discrepancy (or what the watch makes of it) is another one" in result.first_difference.what


# ---------------------------------------------------------------- certificates


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda c: msgspec.structs.replace(c, issued_unix_s=c.issued_unix_s + 200), "it says that it was issued at"),
        (lambda c: msgspec.structs.replace(c, expires_unix_s=c.expires_unix_s + DAY_S), "what it says is not what the evidence says"),
        (lambda c: msgspec.structs.replace(c, verified_radius=2 * c.verified_radius), "its verified radius is not that of"),
        (lambda c: msgspec.structs.replace(c, shown=c.shown[:-1]), "what it says is not what the evidence says"),
        (lambda c: msgspec.structs.replace(c, budget=c.budget / 2), "what it says is not what the evidence says"),
        (lambda c: msgspec.structs.replace(c, task_parameters={"cells": 1}), "what it says is not what the evidence says"),
    ],
    ids=["issued later", "valid longer", "a larger radius", "a sentence left out", "a smaller budget", "another task"],
)
def test_a_certificate_that_says_more_than_its_evidence_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Any], Any], what: str
) -> None:
    honest = audit_bench.certificates.issue
    with monkeypatch.context() as patched:
        patched.setattr(audit_bench.certificates, "issue", lambda **given: change(honest(**given)))
        bench = whole(Bench(tmp_path))
    result = audit([bench.write(tmp_path / "a.mcap")], PUBLIC)
    assert not result.ok
    assert not result.certificates[0].valid
    assert what in result.certificates[0].reason


# ---------------------------------------------------------------- memories


def remembering(**changes: Any) -> Callable[[m.Memory], m.Memory]:
    return lambda memory: msgspec.structs.replace(memory, **changes)


def calmed(memory: m.Memory) -> m.Memory:
    return msgspec.structs.replace(memory, watch_n=0, watch_exceedances=0, watch_e_value=1.0, watch_counts=())


def shrunk(memory: m.Memory) -> m.Memory:
    assert memory.gap is not None
    return msgspec.structs.replace(memory, radius=memory.gap.radius)


def uneasy(bench: Any) -> Any:
    """The robot changes a little: the watch doubts, and refutes nothing."""
    bench.sample().drive(20)
    bench.gain = 1.3
    bench.steps(60)
    return bench.stop()


def begun(bench: Any) -> Any:
    """A campaign that the end of the run interrupts."""
    bench.step()
    bench.ask("permit", duration_s=3600.0)
    bench.ask("sample")
    bench.steps(30)
    return bench.stop()


def traced(bench: Any) -> Any:
    """A tracer found an effect, and nobody adopted the model that has it."""
    bench.gain = 0.7
    return bench.sample().trace().stop()


def better(memory: m.Memory) -> m.Memory:
    """Certificates as they are, but for what they were verified at."""
    improved = (msgspec.structs.replace(one, verified_radius=2.0 * one.verified_radius) for one in memory.certificates)
    return msgspec.structs.replace(memory, certificates=tuple(improved))


def longer(memory: m.Memory) -> m.Memory:
    return msgspec.structs.replace(
        memory, certificates=tuple(msgspec.structs.replace(one, expires_unix_s=one.expires_unix_s + DAY_S) for one in memory.certificates)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("story", "forget", "what"),
    [
        (withdrawn, remembering(revoked={}), "was revoked"),
        (runaway, shrunk, "that the gap grew to"),
        (runaway, remembering(alarm_epoch=0), "that the watch refuted the gap of epoch 1"),
        (runaway, remembering(refuted=()), "samples whose gap was refuted or outgrown"),
        (runaway, calmed, "discrepancies of epoch 1"),
        (whole, remembering(epochs=0), "forgets epochs or attempts"),
        (whole, better, "the memory has another certificate"),
        (whole, longer, "the memory has another certificate"),
        (uneasy, remembering(watch_e_value=1.0), "what the watch made of the"),
        (uneasy, remembering(watch_exchange=1.0), "what the watch made of the"),
        (whole, remembering(campaign_digest="sha256:" + "0" * 64), "with which settings the gap of epoch 1 was measured"),
        (begun, remembering(campaign_n=3), "was fixed beforehand at 14 samples"),
        (traced, remembering(traced=False), "that an effect was traced"),
    ],
    ids=[
        *("a revocation", "a grown gap", "an alarm", "refuted samples", "the stream", "an epoch", "what a certificate was verified at"),
        *("when a certificate ends", "the doubts of the watch", "the doubts of its other test", "settings", "how many samples", "a trace"),
    ],
)
def test_a_later_run_cannot_forget(tmp_path: Path, story: Any, forget: Any, what: str) -> None:
    first = story(Bench(tmp_path))
    memory = first.state.memory
    assert forget(memory) != memory, "there is nothing to forget"
    path = first.write(tmp_path / "a.mcap")
    honest = Bench(tmp_path, memory=memory).stop().write(tmp_path / "b.mcap", run="second")
    told = audit([path, honest], PUBLIC)
    assert told.ok, told.text()
    forgetful = Bench(tmp_path, memory=forget(memory)).stop().write(tmp_path / "c.mcap", run="third")
    result = audit([path, forgetful], PUBLIC)
    assert not result.ok
    assert result.first_difference is not None
    assert what in result.first_difference.what
    assert result.first_difference.channel == "event/started"


# ---------------------------------------------------------------- what other readers would show


def rewritten(bench: Any, path: Path, change: Callable[[bytes], bytes], kind: type) -> AuditResult:
    """The log, with the bytes of one message changed before they are chained and signed."""
    writer, changed = audit_bench.Writer(path, run="bench", signer=KEY, timed=False), []
    honest = writer._encoder.encode

    class Encoder:
        def encode(self, message: Any) -> bytes:
            raw = honest(message)
            if isinstance(message, kind) and not changed and change(raw) != raw:
                changed.append(message)
                return change(raw)
            return raw

    writer._encoder = Encoder()
    for item in bench.items:
        if isinstance(item, tuple):
            writer.attach(*item)
        else:
            writer.write(item, getattr(item, "t_ns", 0))
    writer.close()
    assert changed
    return audit([path], PUBLIC)


@pytest.mark.parametrize("kind", [m.Observed, m.Frame, m.Decided, m.WallClockRead])
def test_a_second_value_under_one_name_is_named(tmp_path: Path, kind: type) -> None:
    """JSON readers differ in which of two equal keys they show."""
    bench = Bench(tmp_path)
    bench.steps(5)
    clock(bench, audit_bench.START_UNIX_S + 1)
    bench.receive(msgspec.json.encode({"u": [9.0, 9.0], "seq": 4}))
    bench.stop()

    def twice(raw: bytes) -> bytes:
        first = raw[1:-1].split(b",")[1]
        return b"{" + first + b"," + raw[1:]

    result = rewritten(bench, tmp_path / "a.mcap", twice, kind)
    assert not result.ok
    assert result.first_difference is not None


def test_a_message_that_stands_at_another_time_than_it_is_of_is_named(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.steps(20)
    bench.stop()
    writer = audit_bench.Writer(tmp_path / "a.mcap", run="bench", signer=KEY, timed=False)
    for number, item in enumerate(bench.items):
        if isinstance(item, tuple):
            writer.attach(*item)
        else:
            writer.write(item, getattr(item, "t_ns", 0) + (10**9 if number > 40 else 0))
    writer.close()
    result = audit([tmp_path / "a.mcap"], PUBLIC)
    assert not result.ok
    assert result.first_difference is not None
    assert "it stands at another time than it is of" in result.first_difference.what


def test_a_certificate_from_elsewhere_is_said_to_have_its_evidence_elsewhere(tmp_path: Path) -> None:
    earlier = Bench(tmp_path).sample().drive(10).stop()
    stored = next(item for item in earlier.items if isinstance(item, m.CertificateStored))
    data = next(item for item in earlier.items if isinstance(item, tuple) and item[0] == f"certificate/{stored.facts.id}")
    bench = Bench(tmp_path)
    bench.steps(3)
    bench.items.append(data)
    bench.feed(msgspec.structs.replace(stored, gap=earlier.state.memory.gap, request_id=0))
    result = audit([bench.stop().write(tmp_path / "a.mcap")], PUBLIC)
    assert result.ok, result.text()
    assert result.missing == [f"the evidence of certificate {stored.facts.id}, which was made elsewhere"]


# ---------------------------------------------------------------- a controller that is run again


@pytest.mark.slow
def test_a_verification_that_was_made_up_is_named_when_the_controller_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Safety values, verdict and certificate fit each other to the last digit; only they are not what the controller gives."""
    monkeypatch.setattr(audit_bench, "PROFILE", audit_bench.PROFILE.replace('[task]\nname = "bench"', '[task]\nname = "keep_out"'))
    plain = Bench(tmp_path).model
    horizon = registry().get("tasks", "keep_out")({}, plain.nominal, plain.dt).horizon
    monkeypatch.setattr(audit_bench.BenchTask, "horizon", horizon)
    made_up = audit_bench.Bench._verify

    def verified(self: Any, order: m.StartJob) -> m.JobFinished:
        gap = self.state.memory.gap
        radii = order.radius, order.hold_radius
        job = VerifyJob(self.profile, self.controller, gap, *radii, order.attempt, order.seed, order.beta, order.least_radius)
        done = jobs.run(job, lambda *_: None)
        return m.JobFinished(0, order.job_id, "verify", verification=done.verification, safety=done.safety)

    for name, verify, holds in (("honest", verified, True), ("lie", made_up, False)):
        monkeypatch.setattr(audit_bench.Bench, "_verify", verify)
        bench = whole(Bench(tmp_path))
        path = bench.write(tmp_path / f"{name}.mcap")
        assert any(isinstance(item, m.JobFinished) and item.verification is not None for item in bench.items)
        assert audit([path], PUBLIC).ok, "what was not run again was not found out, and the audit says that it was not"
        result = audit([path], PUBLIC, rerun_controllers=True)
        assert result.ok == holds, result.text()
        if holds:
            assert result.recomputed["verifications run again"] == 1
        else:
            assert result.first_difference is not None
            assert "verification attempt 1 ends otherwise" in result.first_difference.what
            assert not result.certificates[0].valid


@pytest.mark.slow
def test_what_was_driven_is_what_the_controller_answers_when_it_is_asked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bench's verification is made up, which is the first difference here; what was driven is looked at all the same."""
    monkeypatch.setattr(audit_bench, "PROFILE", audit_bench.PROFILE.replace('[task]\nname = "bench"', '[task]\nname = "keep_out"'))
    plain = Bench(tmp_path).model
    horizon = registry().get("tasks", "keep_out")({}, plain.nominal, plain.dt).horizon
    monkeypatch.setattr(audit_bench.BenchTask, "horizon", horizon)
    again = "driving commands that their controller gives again"
    for lie in ("", "another face"):
        bench = whole(Bench(tmp_path, lie))
        path = bench.write(tmp_path / f"{lie or 'honest'}.mcap")
        driven = sum(isinstance(item, m.Proposed) and item.command.source == "controller" for item in bench.items)
        assert driven > 10
        assert audit([path], PUBLIC).ok, "nothing shows as long as the controller is not asked"
        assert audit([path], PUBLIC, rerun_controllers=True).recomputed.get(again, 0) == (0 if lie else driven)
