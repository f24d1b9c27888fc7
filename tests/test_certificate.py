"""Certificates: what they say, what they are bound to, and that nothing but the signed bytes is taken for one."""

from __future__ import annotations

import base64
import json
from typing import Any

import msgspec
import pytest
from certificate_rig import KEY, NOW, PUBLIC, Evidence, evidence
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.core import anytime
from s2r_runtime.core.ledger import binomial_tail, sample_size
from s2r_runtime.errors import ConfigError, NotEnoughEvidence, S2RError
from s2r_runtime.evidence import statements
from s2r_runtime.evidence.logged_deployments import Run
from s2r_runtime.evidence.trials import Found, trials
from s2r_runtime.messages import RunLimits, Tries
from s2r_runtime.trust import certificate, keys

OTHER = Ed25519PrivateKey.from_private_bytes(bytes(32))


@pytest.fixture(scope="module")
def good() -> Evidence:
    return evidence()


# ---------------------------------------------------------------- signing and loading


@pytest.mark.slow
def test_a_signed_certificate_loads_equal_and_states_its_facts(good: Evidence) -> None:
    issued = good.issue()
    loaded = certificate.load(certificate.sign(issued, KEY), [keys.public_bytes(OTHER), PUBLIC], NOW + 1)
    assert loaded == issued
    facts = certificate.facts(loaded)
    assert facts.id == issued.id
    assert (facts.controller_digest, facts.model_digest) == (good.controller.digest, good.profile.model.digest())
    assert (facts.task_digest, facts.profile_digest) == (good.profile.task_digest(), good.profile.digest())
    assert (facts.radius, facts.verified_radius, facts.epoch, facts.attempt) == (0.004, 0.006, 1, 2)
    assert (facts.issued_unix_s, facts.expires_unix_s) == (NOW, NOW + 3600)


@pytest.mark.slow
def test_a_certificate_of_before_seeds_were_drawn_is_the_same_bytes_and_loads(good: Evidence) -> None:
    before = good.issue()
    data = certificate.sign(before, KEY)
    assert b'"tries"' not in data
    assert certificate.load(data, [PUBLIC], NOW + 1) == before
    after = good.issue(tries=Tries(2, 1, 1))
    assert certificate.load(certificate.sign(after, KEY), [PUBLIC], NOW + 1) == after
    (told,) = (line for line in after.shown if line not in before.shown)
    assert told.startswith("Tries (G4).")
    assert "they were of 1 controllers" in told
    interrupted = good.issue(tries=Tries(2, 2, 1))  # of the other attempt nobody knows how its controller behaves
    assert any("they were of at least 1 controllers" in line for line in interrupted.shown)


@pytest.mark.slow
def test_a_certificate_says_that_a_simulation_fixed_its_seed_and_counts_its_own_attempt(good: Evidence) -> None:
    simulated = good.issue(tries=Tries(2, 1, 1, fixed=True))
    assert any("certifies nothing for a robot" in line for line in simulated.shown)
    with pytest.raises(ConfigError, match="what was tried is not of this attempt"):
        good.issue(tries=Tries(3, 1, 1))


def test_every_single_flipped_bit_is_refused(good: Evidence) -> None:
    data = certificate.sign(good.issue(), KEY)
    taken = []
    for place in range(8 * len(data)):
        changed = bytearray(data)
        changed[place // 8] ^= 1 << place % 8
        try:
            certificate.load(bytes(changed), [PUBLIC])
        except ConfigError:
            continue
        taken.append(place)
    assert taken == []


@pytest.mark.slow
def test_a_file_cut_anywhere_or_longer_is_refused(good: Evidence) -> None:
    data = certificate.sign(good.issue(), KEY)
    for length in range(len(data)):
        with pytest.raises(ConfigError):
            certificate.load(data[:length], [PUBLIC])
    for more in (b"\n", b" ", b"\x00", data, b"x" * certificate.FILE_MAX):
        with pytest.raises(ConfigError):
            certificate.load(data + more, [PUBLIC])


@pytest.mark.slow
def test_the_same_content_in_another_form_is_refused(good: Evidence) -> None:
    data = certificate.sign(good.issue(), KEY)
    plain = json.loads(data)
    forms = [
        json.dumps(plain).encode(),
        json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=True).encode().replace(b"0.004", b"4e-3"),
        data.replace(b'"robot":"rover"', b'"robot":"other","robot":"rover"'),
        data.replace(b'"robot":"rover"', b'"robot":"rove\\u0072"'),
        data.replace(b'"beta":', b'"beta": '),
    ]
    for form in forms:
        assert form != data
        with pytest.raises(ConfigError, match="changed after it was signed"):
            certificate.load(form, [PUBLIC])


@pytest.mark.slow
def test_signatures_with_other_spare_bits_are_refused(good: Evidence) -> None:
    """64 bytes end in a base64 letter with two spare bits: four spellings of one signature, and one is right."""
    data = certificate.sign(good.issue(), KEY)
    signature = json.loads(data)["signature"]
    alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    last = alphabet.index(signature.rstrip("=")[-1])
    same = [signature[:85] + alphabet[last - last % 16 + spare] + "==" for spare in range(16)]
    assert {base64.b64decode(text) for text in same} == {base64.b64decode(signature)}
    refused = 0
    for text in same:
        try:
            certificate.load(data.replace(signature.encode(), text.encode()), [PUBLIC])
        except ConfigError:
            refused += 1
    assert refused == 15


@pytest.mark.slow
def test_a_key_that_is_not_trusted_is_named(good: Evidence) -> None:
    data = certificate.sign(good.issue(), OTHER)
    with pytest.raises(ConfigError, match=rf"signed with the key {keys.fingerprint(keys.public_bytes(OTHER))}.*{keys.fingerprint(PUBLIC)}"):
        certificate.load(data, [PUBLIC])
    with pytest.raises(ConfigError, match="trusted: none"):
        certificate.load(data, [])


@pytest.mark.slow
def test_a_trusted_name_over_somebody_elses_signature_is_refused(good: Evidence) -> None:
    by_other = certificate.sign(good.issue(), OTHER)
    as_ours = by_other.replace(base64.b64encode(keys.public_bytes(OTHER)), base64.b64encode(PUBLIC))
    assert as_ours != by_other
    with pytest.raises(ConfigError, match="the signature does not fit"):
        certificate.load(as_ours, [PUBLIC])


@pytest.mark.slow
def test_content_that_was_changed_with_its_id_is_refused(good: Evidence) -> None:
    issued = good.issue()
    longer = msgspec.structs.replace(issued, expires_unix_s=issued.expires_unix_s + 1)
    forged = json.loads(certificate.sign(longer, OTHER)) | {
        name: json.loads(certificate.sign(issued, KEY))[name] for name in ("signature", "public_key")
    }
    with pytest.raises(ConfigError, match="the signature does not fit"):
        certificate.load(msgspec.json.encode(forged, order="deterministic"), [PUBLIC])


@pytest.mark.slow
def test_expired_and_not_yet_issued_are_refused_with_the_seconds(good: Evidence) -> None:
    data = certificate.sign(good.issue(), KEY)
    certificate.load(data, [PUBLIC], NOW + 3599)
    with pytest.raises(ConfigError, match="expired 0 s ago"):
        certificate.load(data, [PUBLIC], NOW + 3600)
    certificate.load(data, [PUBLIC], NOW - certificate.CLOCKS_APART_S)
    with pytest.raises(ConfigError, match="issued 61 s from now"):
        certificate.load(data, [PUBLIC], NOW - certificate.CLOCKS_APART_S - 1)


@pytest.mark.slow
def test_another_schema_is_said_to_be_one(good: Evidence) -> None:
    newer = certificate.sign(msgspec.structs.replace(good.issue(), schema=3), KEY)
    with pytest.raises(ConfigError, match="certificate schema 3, this version reads 2"):
        certificate.load(newer, [PUBLIC])
    with_new_field = newer.replace(b'"schema":3', b'"schema":3,"weather":"fine"')
    with pytest.raises(ConfigError, match="certificate schema 3, this version reads 2"):
        certificate.load(with_new_field, [PUBLIC])


@given(st.binary(max_size=300) | st.text(max_size=300).map(str.encode))
@settings(max_examples=300, deadline=None)
def test_bytes_that_are_no_certificate_are_refused_with_one_line(data: bytes) -> None:
    with pytest.raises(ConfigError) as refused:
        certificate.load(data, [PUBLIC])
    assert "\n" not in str(refused.value)


def test_deeply_nested_json_is_refused() -> None:
    with pytest.raises(ConfigError, match="is no certificate"):
        certificate.load(b'{"certificate":{"controller":{"parameters":' + b"[" * 100_000, [PUBLIC])


@pytest.mark.slow
def test_whole_numbers_in_places_for_fractions_do_not_spoil_a_certificate(good: Evidence) -> None:
    whole = good.with_gap(radius_literal=1, weights=(1, 1, 0.0525)).issue()
    data = certificate.sign(whole, KEY)
    assert certificate.load(data, [PUBLIC]).id == whole.id


@pytest.mark.slow
def test_parts_of_different_certificates_do_not_load_even_when_signed(good: Evidence) -> None:
    issued = good.issue()
    changes: list[tuple[str, dict[str, Any]]] = [
        ("its controller digest", {"controller_digest": "sha256:00"}),
        ("its controller digest", {"controller": msgspec.structs.replace(issued.controller, parameters={"speed": 9.0})}),
        ("its model digest", {"model": msgspec.structs.replace(issued.model, dt=0.02)}),
        ("of another task", {"task_digest": "sha256:00"}),
        ("its verified radius", {"verified_radius": 1.0}),
        ("expires before", {"expires_unix_s": NOW}),
    ]
    for message, change in changes:
        with pytest.raises(ConfigError, match=message):
            certificate.load(certificate.sign(msgspec.structs.replace(issued, **change), KEY), [PUBLIC])


# ---------------------------------------------------------------- issuing


@pytest.mark.slow
def test_what_the_evidence_does_not_carry_is_not_certified(good: Evidence) -> None:
    first = good.verification.laws[0]
    short = msgspec.structs.replace(first, n=first.n - 1)
    lost = msgspec.structs.replace(first, s_star=-1.0, failures=1, passed=False)
    still = msgspec.structs.replace(first, progress_ok=False)
    rest = good.verification.laws[1:]
    cases: list[tuple[str, Evidence]] = [
        ("did not pass verification: s. below", good.with_verification(passed=False, reason="s* below threshold")),
        ("a required law was not passed", good.with_verification(laws=(lost, *rest))),
        ("a required law was not passed", good.with_verification(laws=(still, *rest))),
        ("verified radius is below the gap", good.with_verification(radius=0.0039)),
        ("verified radius is below the gap", good.with_verification(hold_radius=0.029)),
        ("the gap spends more than its epoch's share", good.with_gap(epoch=2)),
        ("spends more than its attempt's share", good.with_verification(attempt=3)),
        ("160 samples do not carry", good.with_gap(n=good.gap.n - 1)),
        (f"{short.n} scenarios do not carry", good.with_verification(laws=(short, *rest))),
    ]
    for message, case in cases:
        with pytest.raises(NotEnoughEvidence, match=message) as refused:
            case.issue()
        assert refused.value.exit_code == 3
    with pytest.raises(NotEnoughEvidence) as refused:
        good.with_gap(n=100).issue()
    assert refused.value.missing == 61


@pytest.mark.slow
def test_what_belongs_to_something_else_is_not_certified(good: Evidence) -> None:
    cases: list[tuple[str, Evidence]] = [
        ("verification is of another controller", good.with_verification(controller_digest="sha256:00")),
        ("verification is of another model", good.with_verification(model_digest="sha256:00")),
        ("verification is of another task", good.with_verification(task_digest="sha256:00")),
        ("gap is of another model", good.with_gap(model_digest="sha256:00")),
        ("gap's epsilon is above the profile's", good.with_gap(epsilon=0.04)),
        ("set or discards are not the profile's", good.with_gap(set="box")),
        ("verification's epsilon is above", good.with_verification(epsilon=0.04)),
        ("threshold is below the profile's", good.with_verification(threshold=-0.1)),
        ("a disturbance law that the profile requires", good.with_verification(laws=good.verification.laws[:1])),
    ]
    for message, case in cases:
        with pytest.raises(ConfigError, match=message):
            case.issue()


@pytest.mark.slow
def test_uniform_alone_is_said_and_refused_where_structure_remains(good: Evidence) -> None:
    n = sample_size(0.03, good.verification.beta)
    alone = good.with_laws("uniform", "persistent", required=("uniform",), n=n)
    assert "uniform alone" in alone.issue().not_shown[0]
    assert not any("uniform alone" in line for line in good.issue().not_shown)
    with pytest.raises(NotEnoughEvidence, match="the residual is not white: drifts"):
        alone.with_gap(white=False, white_reason="drifts").issue()
    with pytest.raises(NotEnoughEvidence, match="an effect was traced"):
        alone.issue(traced_not_adopted=True)
    good.with_gap(white=False).issue(traced_not_adopted=True)  # persistent was required and passed


# ---------------------------------------------------------------- the sentences


@pytest.mark.slow
def test_the_sentences_say_what_the_numbers_say_and_carry_both_lists(good: Evidence) -> None:
    issued = good.issue()
    shown, hidden = "\n".join(issued.shown), "\n".join(issued.not_shown)
    gap_confidence, check_confidence = statements.confidence(good.gap.beta), statements.confidence(good.verification.beta)
    for part in (
        f"With confidence {gap_confidence}, a new discrepancy between robot 'rover' and one step of 0.033 s",
        "unicycle + input_delay(*)",
        "exceeds r = 0.004 (ball, weights 1, 1, 0.0525) with probability at most 0.03",
        "after 50 held periods exceeds r_h = 0.03",
        "161 transitions, none of the largest discarded, both numbers fixed beforehand",
        "In the unweighted norm r is 0.05; noise alone would make about 0.002 of r",
        f"law persistent). With confidence {check_confidence}, a new rollout of the uncertain model",
        "disturbed within 0.006, 1.5 times r, with at most 0.045 over a hold",
        "scores below s* = 0.25 with probability at most 0.03",
        "Reported, not required: under the law adversarial",
        f"hold at once with confidence {statements.confidence(good.gap.beta + good.verification.beta)}",
        "Gap epoch 1 spent 0.0151982 and verification attempt 2",
    ):
        assert part in shown
    for part in ("do not compose", "In a run of 200 steps", "rho epsilon", "averages out", "measurement noise is inside r", "(G9)"):
        assert part in hidden


@pytest.mark.slow
def test_an_assumption_of_the_users_stands_in_the_statement(good: Evidence) -> None:
    shown = "\n".join(good.issue(assumption="blocks of 10 s are independent").shown)
    assert "their independence rests on an assumption that the user made: blocks of 10 s are independent" in shown
    assert "were drawn independently, one from each held input" not in shown


@given(st.floats(min_value=1e-12, max_value=1e6))
@settings(max_examples=300, deadline=None)
def test_printed_numbers_never_flatter(value: float) -> None:
    assert float(statements.bound(value)) >= value
    assert float(statements.worst(value)) <= value
    assert float(statements.bound(value)) <= value * (1 + 1e-5)


@given(st.floats(min_value=1e-15, max_value=0.5))
@settings(max_examples=300, deadline=None)
def test_printed_confidence_is_never_above_the_true_one(beta: float) -> None:
    assert float(statements.confidence(beta).split()[0]) <= 100.0 * (1.0 - beta) + 1e-12


@pytest.mark.slow
def test_the_counts_that_pass_are_the_least_that_carry_the_statement(good: Evidence) -> None:
    assert binomial_tail(good.gap.n, 0, 0.03) <= good.gap.beta / 2 < binomial_tail(good.gap.n - 1, 0, 0.03)
    good.with_gap(hold_periods=1, n=sample_size(0.03, good.gap.beta)).issue()  # without a hold gap r has the whole share
    with pytest.raises(S2RError):
        good.with_gap(hold_periods=1, n=sample_size(0.03, good.gap.beta) - 1).issue()


@pytest.mark.slow
def test_a_certificate_carries_trials_of_its_own_controller_only_and_says_them(good: Evidence) -> None:
    without = good.issue()
    digests = {"controller_digest": without.controller_digest, "task_digest": without.task_digest, "model_digest": without.model_digest}
    told = trials(Found([(Run(0, 0, 3, 0.5, discrepancy=0.001), True)] * 299), **digests, beta=0.05)
    carrying = good.issue(trials=told)
    assert any(line.startswith("Trials (G9)") for line in carrying.shown)
    assert not any("No closed-loop trials" in line for line in carrying.not_shown)
    assert any("No closed-loop trials" in line for line in without.not_shown)
    assert carrying.id != without.id
    with pytest.raises(ConfigError, match="the trials are of another controller"):
        good.issue(trials=msgspec.structs.replace(told, controller_digest="other"))
    for wrong in ({"unsafe_upper": 0.001}, {"epsilon": 0.001}, {"unsafe": 300}, {"n": 0}, {"radius": -1.0}):
        with pytest.raises(NotEnoughEvidence, match="the trials do not carry their statement"):
            good.issue(trials=msgspec.structs.replace(told, **wrong))


def test_a_certificate_carries_the_runs_of_its_controller_with_limits_that_follow_from_their_counts(good: Evidence) -> None:
    found = anytime.limits(anytime.Counts(300, 2, 1), 0.015, 0.045)
    counted = RunLimits("", 1, 300, 2, 1, found.lower, found.upper, 0.015, 0.045)
    without, carrying = good.issue(), good.issue(runs=counted)
    assert [line for line in carrying.shown if line not in without.shown] == [statements.of_runs(counted)]
    assert certificate.load(certificate.sign(carrying, KEY), [PUBLIC], NOW + 1).runs == counted
    assert b'"runs"' not in certificate.sign(without, KEY), "as it was before runs were counted"
    for wrong in (
        {"upper": 0.5 * found.upper},
        {"lower": 2.0 * found.lower},
        {"unsafe": 1},
        {"unsafe": -1},
        {"unsafe": 300},
        {"censored": -1},
        {"n": 299},
        {"beta_upper": 0.0},
        {"beta_lower": 1.0},
        {"beta_upper": 0.09},
    ):
        with pytest.raises(NotEnoughEvidence, match="the limits of its runs do not follow from their counts"):
            good.issue(runs=msgspec.structs.replace(counted, **wrong))
