"""What carries a certificate, number by number: each condition alone, at its bound and beside it, and how much is lacking."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from certificate_rig import KEY, NOW, PROFILE, PUBLIC, Evidence, evidence, law

from s2r_runtime.core.ledger import binomial_tail, campaign_size, sample_size, share
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence import statements
from s2r_runtime.files.canonical import canonical
from s2r_runtime.messages import Trials
from s2r_runtime.profile import parse_profile
from s2r_runtime.trust import certificate, keys
from s2r_runtime.trust.certificate import Certificate

replace = msgspec.structs.replace
SLACK = 1.0 + 1e-9


@pytest.fixture(scope="module")
def good() -> Evidence:
    return evidence()


def lacking(c: Certificate, *, traced: bool = False) -> list[tuple[str, int]]:
    """What the evidence of this certificate lacks, and how many samples more would do."""
    return [(what, missing) for what, ok, missing in certificate._evidence(c, traced_not_adopted=traced) if not ok]


# ---------------------------------------------------------------- issuing


def test_an_identity_will_do_for_a_controller_and_the_lifetime_is_the_profiles_unless_given(good: Evidence) -> None:
    issued = certificate.issue(
        profile=good.profile, controller=good.controller.identity, gap=good.gap, verification=good.verification, issued_unix_s=NOW
    )
    assert issued.expires_unix_s - issued.issued_unix_s == round(good.profile.certificate.lifetime)
    assert issued.controller == good.issue().controller
    assert good.issue(lifetime_s=7).expires_unix_s == NOW + 7


@pytest.mark.parametrize("field", ["verified_radius", "verified_hold_radius"])
def test_both_verified_radii_are_those_of_the_verification(good: Evidence, field: str) -> None:
    changed = replace(good.issue(), **{field: 0.5})
    with pytest.raises(ConfigError, match="its verified radius is not that of the verification"):
        certificate.load(certificate.sign(changed, KEY), [PUBLIC])


def test_a_law_that_was_only_reported_is_not_one_that_was_required(good: Evidence) -> None:
    laws = (good.verification.laws[0], replace(good.verification.laws[1], required=False))
    with pytest.raises(ConfigError, match="a disturbance law that the profile requires"):
        good.with_verification(laws=laws).issue()


def test_discards_are_the_profiles_whatever_the_set(good: Evidence) -> None:
    with pytest.raises(ConfigError, match="set or discards are not the profile's"):
        good.with_gap(discarded=1).issue()


def test_every_lack_is_named_alone_and_only_samples_can_be_added(good: Evidence) -> None:
    issued = good.issue()
    assert lacking(issued) == []
    assert lacking(issued, traced=True) == []
    v, gap = issued.verification, issued.gap
    first, second, third = v.laws
    alone = replace(v, laws=(first, replace(second, required=False), third))
    serial = "the error of a sample depends on the one before: r = 0.9"
    cases: list[tuple[dict[str, Any], str]] = [
        ({"verification": replace(v, passed=False)}, "the controller did not pass verification"),
        ({"verification": replace(v, passed=False, reason="too slow")}, "the controller did not pass verification: too slow"),
        ({"verification": replace(v, laws=(replace(first, passed=False), second))}, "a required law was not passed"),
        ({"verification": replace(v, laws=(replace(first, progress_ok=False), second))}, "a required law was not passed"),
        ({"verification": replace(v, laws=(replace(first, s_star=-1e-9), second))}, "a required law was not passed"),
        ({"verification": replace(v, radius=math.nextafter(gap.radius, 0.0))}, "the verified radius is below the gap"),
        ({"verification": replace(v, hold_radius=math.nextafter(gap.hold_radius, 0.0))}, "the verified radius is below the gap"),
        ({"gap": replace(gap, white_reason=serial)}, f"the samples were not drawn independently: {serial}"),
        (
            {"verification": alone, "gap": replace(gap, white=False)},
            "only the law uniform was required, and the residual is not white",
        ),
        (
            {"verification": alone, "gap": replace(gap, white=False, white_reason="drifts")},
            "only the law uniform was required, and the residual is not white: drifts",
        ),
        ({"trials": TRIALS, "budget": 0.05} | {"trials": replace(TRIALS, n=0, unsafe=0)}, "the trials do not carry their statement"),
    ]
    for changes, what in cases:
        assert lacking(replace(issued, **changes)) == [(what, 0)], what
    traced = "only the law uniform was required, and an effect was traced that the model lacks"
    assert lacking(replace(issued, verification=alone), traced=True) == [(traced, 0)]
    assert lacking(replace(issued, verification=alone)) == []


def test_without_a_required_law_nothing_was_shown(good: Evidence) -> None:
    issued = good.issue()
    none = replace(issued.verification, laws=tuple(replace(one, required=False) for one in issued.verification.laws))
    found = lacking(replace(issued, verification=none))
    n = sample_size(none.epsilon, none.beta)
    assert found == [("no disturbance law was required", 0), ("0 scenarios do not carry the verification's statement", n)]
    assert lacking(replace(issued, verification=replace(none, laws=())))[0] == ("no disturbance law was required", 0)


def test_what_stands_exactly_at_its_bound_carries(good: Evidence) -> None:
    issued = good.issue()
    v, gap = issued.verification, issued.gap
    laws = tuple(replace(one, s_star=v.threshold) for one in v.laws)
    at_bounds = replace(v, radius=gap.radius, hold_radius=gap.hold_radius, laws=laws)
    assert lacking(replace(issued, verification=at_bounds)) == []
    two_periods = replace(issued, gap=replace(gap, hold_periods=2), verification=replace(v, hold_radius=0.0))
    assert lacking(two_periods) == [("the verified radius is below the gap", 0)]
    one_period = replace(gap, hold_periods=1)
    assert lacking(replace(issued, gap=one_period, verification=replace(v, hold_radius=0.0))) == []


def test_shares_may_differ_in_their_last_digits_only(good: Evidence) -> None:
    issued = good.issue()
    for name, part, spends in (
        ("gap", issued.gap, "the gap spends more than its epoch's share of beta"),
        ("verification", issued.verification, "the verification spends more than its attempt's share of beta"),
    ):
        number = 1 if name == "gap" else issued.verification.attempt
        for factor, ok in ((SLACK, True), (1.0 + 1.5e-9, False)):
            changed = replace(issued, **{name: replace(part, beta=share(issued.budget, number) * factor)})
            assert lacking(changed) == ([] if ok else [(spends, 0)])


def exact(tail: float, parts: float) -> float:
    """A beta of which the part, with its slack, is exactly this probability."""
    beta = tail / SLACK * parts
    for _ in range(50):
        found = beta / parts * SLACK
        if found == tail:
            return beta
        beta = math.nextafter(beta, math.inf if found < tail else 0.0)
    pytest.skip("no float hits it")


def test_samples_carry_down_to_the_last_digits_of_their_share(good: Evidence) -> None:
    issued = good.issue()
    gap = issued.gap
    tail = binomial_tail(gap.n, 0, gap.epsilon)
    for periods, parts in ((50, 2.0), (1, 1.0)):
        enough = replace(gap, hold_periods=periods, beta=exact(tail, parts))
        assert lacking(replace(issued, gap=enough)) == []
        short = replace(enough, beta=tail * parts / (1.0 + 1.5e-9))
        needed = campaign_size(gap.epsilon, short.beta, 0) if periods > 1 else sample_size(gap.epsilon, short.beta, 0)
        assert lacking(replace(issued, gap=short)) == [(f"{gap.n} samples do not carry the gap's statement", needed - gap.n)]
        assert needed - gap.n == 1


def test_scenarios_carry_down_to_the_last_digits_of_their_share_of_each_radius(good: Evidence) -> None:
    issued = good.issue()
    v = issued.verification
    n = v.laws[0].n
    tail = binomial_tail(n, 0, v.epsilon)
    lack = f"{n} scenarios do not carry the verification's statement"
    for split in (1, 2, 7):
        few = tuple(replace(one, n=sample_size(v.epsilon, v.beta / split)) for one in v.laws)
        assert lacking(replace(issued, verification=replace(v, split=split, laws=few))) == []
        assert lacking(replace(issued, verification=replace(v, split=split, beta=exact(tail, split)))) == [] or split * tail > v.beta
        short = replace(v, split=split, beta=tail * split / (1.0 + 1.5e-9))
        if short.beta <= share(issued.budget, v.attempt):
            assert lacking(replace(issued, verification=short)) == [(lack, 1)]
        less = tuple(replace(one, n=one.n - 5) for one in few)
        missing = lacking(replace(issued, verification=replace(v, split=split, laws=less)))
        assert missing == [(f"{less[0].n} scenarios do not carry the verification's statement", 5)]
    nothing = lacking(replace(issued, verification=replace(v, split=0)))
    assert nothing == [(lack, sample_size(v.epsilon, v.beta) - n)]


# ---------------------------------------------------------------- trials

TRIALS = Trials(100, 2, 0.063, 0.1, 0.02, 0.0296, 0.05, True, {}, (), "controller", "task", "model")


@pytest.mark.parametrize(
    ("changes", "carries"),
    [
        ({}, True),
        ({"unsafe": 100, "unsafe_upper": 1.0}, True),
        ({"unsafe": 100, "unsafe_upper": 0.9}, False),  # all were unsafe: nothing below 1 is a bound
        ({"unsafe": 101, "unsafe_upper": 1.0}, False),
        ({"unsafe": -1}, False),
        ({"n": 0, "unsafe": 0, "unsafe_upper": 1.0, "epsilon": 0.99}, False),
        ({"n": 1, "unsafe": 1, "unsafe_upper": 1.0, "epsilon": 0.96}, True),
        ({"radius": 0.0}, True),
        ({"radius": -1e-9}, False),
        ({"unsafe_upper": 0.061}, False),
        ({"unsafe_upper": 0.0}, False),
        ({"unsafe_upper": 1.0}, False),
        ({"unsafe_upper": 1.5}, False),
        ({"unsafe_upper": math.nan}, False),
        ({"epsilon": 0.029}, False),
        ({"epsilon": 0.0}, False),
        ({"epsilon": 1.0}, False),
        ({"epsilon": 1.5}, False),
        ({"beta": 0.0}, False),
        ({"beta": 1.0}, False),
        ({"beta": 1.5}, False),
        ({"beta": 0.04}, False),
    ],
    ids=str,
)
def test_trials_carry_what_their_numbers_say_and_nothing_else(changes: dict[str, Any], carries: bool) -> None:
    assert certificate._carried(replace(TRIALS, **changes), SLACK) is carries


def test_trials_carry_down_to_the_last_digits() -> None:
    unsafe, radius = binomial_tail(100, 2, TRIALS.unsafe_upper), binomial_tail(100, 0, TRIALS.epsilon)
    one, other = replace(TRIALS, beta=unsafe, epsilon=0.5), replace(TRIALS, beta=radius, unsafe_upper=0.5)
    for exactly in (one, other):
        assert certificate._carried(exactly, 1.0)
        assert not certificate._carried(replace(exactly, beta=math.nextafter(exactly.beta, 0.0)), 1.0)


# ---------------------------------------------------------------- loading


def test_a_file_that_is_too_long_is_refused_before_anything_is_read_of_it() -> None:
    longest = b" " * certificate.FILE_MAX
    with pytest.raises(ConfigError, match="is no certificate"):
        certificate.load(longest, [PUBLIC])
    with pytest.raises(ConfigError, match=f"has {len(longest) + 1} bytes, a certificate has at most {len(longest)}"):
        certificate.load(longest + b" ", [PUBLIC])


def test_the_limits_of_a_file_and_what_is_signed_are_these(good: Evidence) -> None:
    assert (certificate.FILE_MAX, certificate.CLOCKS_APART_S, certificate.SCHEMA) == (1_048_576, 60, 2)
    signed = json.loads(certificate.sign(good.issue(), KEY))
    content = canonical(signed["certificate"])
    KEY.public_key().verify(base64.b64decode(signed["signature"]), b"s2r certificate 1\n" + content)
    with pytest.raises(ConfigError, match=r"^certificate: is no certificate"):
        certificate.load(b"", [PUBLIC])


def test_what_is_not_said_when_issuing_is_not_assumed(good: Evidence) -> None:
    n = sample_size(0.03, good.verification.beta)
    alone = good.with_laws("uniform", "persistent", required=("uniform",), n=n)
    issued = certificate.issue(
        profile=alone.profile, controller=alone.controller, gap=alone.gap, verification=alone.verification, issued_unix_s=NOW
    )  # no effect was traced
    assert issued.not_shown == statements.not_shown(alone.gap, alone.verification, 0, trials=False)
    assert issued.trials is None


def test_an_id_of_another_content_is_refused_as_such(good: Evidence) -> None:
    plain = json.loads(certificate.sign(good.issue(), KEY)) | {"id": "sha256:" + "0" * 64}
    with pytest.raises(ConfigError, match="its id is that of another content"):
        certificate.load(canonical(plain), [PUBLIC])


def test_where_nobody_is_trusted_it_says_so(good: Evidence) -> None:
    with pytest.raises(ConfigError, match=r"\(trusted: none\)$"):
        certificate.load(certificate.sign(good.issue(), KEY), [])


@pytest.mark.parametrize(
    "data",
    [
        b'{"certificate":{"schema":2,"controller":{"parameters":{"a":' + b"[" * 50_000 + b"]" * 50_000 + b"}}}}",
        b'{"certificate":5}',
        b'{"certificate":{}}',
        b"[]",
        b"{}",
        b"",
        b'{"id":"\xff"}',
        b"\xff",
        b'{"certificate":{"schema":2}}',
    ],
    ids=["deep", "a number", "empty", "a list", "nothing in it", "nothing", "no text", "no JSON", "this schema, damaged"],
)
def test_what_is_no_certificate_is_said_to_be_none_whatever_its_schema_might_be(data: bytes) -> None:
    with pytest.raises(ConfigError, match="is no certificate, or was changed after it was signed"):
        certificate.load(data, [PUBLIC])
    assert certificate.signer(data) == b""


def test_the_key_that_stands_in_a_file_is_seen_without_a_check(good: Evidence) -> None:
    data = certificate.sign(good.issue(), KEY)
    assert certificate.signer(data) == keys.public_bytes(KEY)


# ---------------------------------------------------------------- assumptions

DRIVING = '\n[driving]\nblock = 2.0\nbecause = "the robot forgets within a second"\n'


def test_a_certificate_on_an_assumption_counts_where_the_profile_makes_the_same(good: Evidence) -> None:
    none = good.profile
    makes = parse_profile(PROFILE + DRIVING, "test.toml", Path())
    another = parse_profile(PROFILE + DRIVING.replace("2.0", "0.5"), "test.toml", Path())
    plain, resting = good.issue(), good.issue(assumption=statements.assumption(makes.driving))
    for profile in (none, makes, another):
        assert certificate.assumption_problem(plain, profile) == ""
    assert certificate.assumption_problem(resting, makes) == ""
    assert "and the profile makes none ([driving])" in certificate.assumption_problem(resting, none)
    found = certificate.assumption_problem(resting, another)
    assert found == f"its gap rests on another assumption than the profile's: {statements.assumption(another.driving)}"
    twice = replace(resting, shown=(*resting.shown, f"The same {statements.ASSUMED}: the weather is fine"))
    assert "rests on another assumption" in certificate.assumption_problem(twice, makes)


def test_not_enough_evidence_says_what_is_missing_in_its_own_words(good: Evidence) -> None:
    with pytest.raises(NotEnoughEvidence, match=r"no certificate: the controller did not pass verification$") as refused:
        good.with_verification(passed=False).issue()
    assert refused.value.missing == 0
    assert law("uniform").required
