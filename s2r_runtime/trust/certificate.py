"""A certificate: what was shown of one controller on one model of one robot in one task, and an Ed25519 signature (docs/gate.md).

    content   = canonical JSON of `Certificate`            id = its SHA-256
    file      = canonical JSON of {certificate, id, public_key, signature}
    signature = Ed25519(key, b"s2r certificate 1\\n" + content)

There is one file for each content and key: any other bytes, one bit away or far, are refused. Issuing checks that the numbers carry
the sentences and that the digests belong together; loading checks the signature against trusted keys. Then the
gate only compares digests.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.controllers.file import ControllerFile, Identity
from s2r_runtime.core import anytime
from s2r_runtime.core.ledger import binomial_tail, campaign_size, sample_size, share
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence import statements
from s2r_runtime.files.canonical import canonical, digest
from s2r_runtime.messages import (
    NOT_INDEPENDENT,
    CertificateFacts,
    Composition,
    Gap,
    RunLimits,
    Simulated,
    Struct,
    Trials,
    Tries,
    Verification,
)
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Profile, TaskValue
from s2r_runtime.trust import keys

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

SCHEMA = 2
FILE_MAX = 1 << 20
"""Bytes. A certificate has about 6000."""
CLOCKS_APART_S = 60
"""How far the clock of the computer that signed may be ahead of this one's."""
_DOMAIN = b"s2r certificate 1\n"


class UntrustedKey(ConfigError):
    """A certificate whose signer is not among the keys that are trusted here."""


class Certificate(Struct, frozen=True):
    """Everything that was shown, and what it is bound to. `budget`: beta of the robot's life, of which gap and verification are shares."""

    schema: int
    robot: str
    controller: Identity
    controller_digest: str
    model: ModelSpec
    model_digest: str
    task: str
    task_parameters: dict[str, TaskValue]
    task_digest: str
    profile_digest: str
    gap: Gap
    verified_radius: float
    verified_hold_radius: float
    verification: Verification
    budget: float
    shown: tuple[str, ...]
    not_shown: tuple[str, ...]
    issued_unix_s: int
    expires_unix_s: int
    trials: Trials | None = None
    tries: Tries | None = None
    """None: issued before seeds were drawn. Then the key is not in the file, as it was not then."""
    runs: RunLimits | None = None
    """Of this controller on this robot until then (guarantee G10). None: it drove none, or they were not counted; then the same holds."""
    composition: Composition | None = None
    """What holds for the real closed loop (guarantee G13). None: nothing was composed; then the same holds."""

    @property
    def id(self) -> str:
        """Digest of the content."""
        return digest(_content(self))


class _Signed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    certificate: Certificate
    id: str
    public_key: bytes
    signature: bytes


def issue(
    *,
    profile: Profile,
    controller: ControllerFile | Identity,
    gap: Gap,
    verification: Verification,
    issued_unix_s: int,
    lifetime_s: int | None = None,
    horizon: int = 0,
    assumption: str = "",
    traced_not_adopted: bool = False,
    trials: Trials | None = None,
    period: str = "",
    tries: Tries | None = None,
    runs: RunLimits | None = None,
    composition: Composition | None = None,
) -> Certificate:
    """Writes down what gap and verification show, if they show it. profile: with the model in force.

    lifetime_s: the profile's unless given. horizon: the task's, for the sentences. assumption: one the user made about independence.
    trials: closed-loop runs, if there were any. period: of each hold that gave the sample, where that is not what the profile says.
    tries: what was tried until this attempt (None: as a certificate of before, whose seed anybody knew beforehand).
    runs: of this controller on this robot, with their limits. composition: scenarios enclosed at this attempt's shares, and runs.
    Raises NotEnoughEvidence if the evidence doesn't carry a certificate, ConfigError if its parts don't belong together.
    """
    identity = controller.identity if isinstance(controller, ControllerFile) else controller
    lifetime = round(profile.certificate.lifetime) if lifetime_s is None else lifetime_s
    budget = profile.guarantee.beta
    certificate = Certificate(
        schema=SCHEMA,
        robot=profile.robot.name,
        controller=identity,
        controller_digest=identity.digest(),
        model=profile.model,
        model_digest=profile.model.digest(),
        task=profile.task.name,
        task_parameters=profile.task.parameters,
        task_digest=profile.task_digest(),
        profile_digest=profile.digest(),
        gap=gap,
        verified_radius=verification.radius,
        verified_hold_radius=verification.hold_radius,
        verification=verification,
        budget=budget,
        shown=statements.shown(
            profile.robot.name,
            profile.model,
            profile.task.name,
            gap,
            verification,
            budget,
            assumption,
            trials,
            period or profile.sampling.period,
            tries,
            runs,
            composition,
        ),
        not_shown=statements.not_shown(gap, verification, horizon, trials=trials is not None, composed=composition is not None),
        issued_unix_s=issued_unix_s,
        expires_unix_s=issued_unix_s + lifetime,
        trials=trials,
        tries=tries,
        runs=runs,
        composition=composition,
    )
    for what, ok in (*_bindings(certificate), *_asked_for(profile, gap, verification), *_composed_for(profile, certificate)):
        if not ok:
            raise ConfigError(f"no certificate: {what}")
    for lack, ok, missing in _evidence(certificate, traced_not_adopted=traced_not_adopted):
        if not ok:
            raise NotEnoughEvidence(f"no certificate: {lack}", missing)
    if lack := optimism_lack(profile, trials):
        raise NotEnoughEvidence(f"no certificate: {lack}")
    return certificate


def optimism_lack(profile: Profile, trials: Trials | None) -> str:
    """Why what is known of the model's optimism does not meet the profile's demand (guarantee G12), or empty."""
    most = profile.verification.max_optimism
    if most >= 1.0:
        return ""
    found = trials.simulated if trials is not None else None
    if found is None or found.score != "safe":
        return (
            f"verification.max_optimism is {most:g}, and nothing is known of the model's optimism on this task; certify with logs of the "
            "controller's runs (s2r certify --trials LOG)"
        )
    if found.optimism.upper > most:
        return (
            f"the model's share of safe runs is shown to exceed the robot's by at most {statements.bound(found.optimism.upper)} only "
            f"({found.optimism.n} runs, {found.optimism.mean:.3g} on average), and verification.max_optimism is {most:g}; more runs "
            "make the limit smaller where the model is right"
        )
    return ""


def sign(certificate: Certificate, key: Ed25519PrivateKey) -> bytes:
    """The bytes of the certificate's file."""
    content = _content(certificate)
    plain = msgspec.json.decode(content, type=Certificate)
    return _file(_Signed(plain, digest(content), keys.public_bytes(key), key.sign(_DOMAIN + content)))


def load(data: bytes, trusted_keys: Iterable[bytes], now_unix_s: int | None = None, where: str = "certificate") -> Certificate:
    """The certificate, if one of these public keys signed exactly this. now_unix_s: also refuse one that is not valid then.

    Raises ConfigError saying why not: no certificate, changed after it was signed, signed by an unknown key, expired, of another schema.
    """
    if len(data) > FILE_MAX:
        raise ConfigError(f"{where}: has {len(data)} bytes, a certificate has at most {FILE_MAX}")
    signed = _decode(data, where)
    if _file(signed) != data:
        raise ConfigError(f"{where}: was changed after it was signed (not the form in which it is written)")
    content = _content(signed.certificate)
    if signed.id != digest(content):
        raise ConfigError(f"{where}: was changed after it was signed (its id is that of another content)")
    trusted = tuple(trusted_keys)
    if signed.public_key not in trusted:
        known = ", ".join(map(keys.fingerprint, trusted)) or "none"
        raise UntrustedKey(
            f"{where}: is signed with the key {keys.fingerprint(signed.public_key)}, which is not trusted here (trusted: {known})"
        )
    if not keys.fits(signed.public_key, signed.signature, _DOMAIN + content):
        raise ConfigError(f"{where}: was changed after it was signed (the signature does not fit)")
    _check_content(signed.certificate, now_unix_s, where)
    return signed.certificate


def signer(data: bytes) -> bytes:
    """The public key that stands in a certificate's file, which says nothing yet; empty if there is none to be seen."""

    class Key(msgspec.Struct):
        public_key: bytes = b""

    try:
        return msgspec.json.decode(data, type=Key).public_key
    except (ValueError, RecursionError):
        return b""


def fixed_seed_problem(facts: CertificateFacts) -> str:
    """Why these certify nothing for a robot, or empty."""
    return "is of a simulation that fixed its seeds beforehand; it certifies nothing for a robot" if facts.fixed_seed else ""


def assumption_problem(certificate: Certificate, profile: Profile) -> str:
    """Why this profile does not vouch for what the certificate's gap rests on, or empty. (Its key vouches for the rest.)"""
    rests = [line for line in certificate.shown if statements.ASSUMED in line]
    if not rests:
        from_stops = any(statements.HELD["first"] in line for line in certificate.shown)
        if from_stops and profile.sampling.period != "first":
            return 'its gap was sampled from full stops, and the profile says sampling.period = "random"'
        return ""
    if profile.driving.block <= 0.0:
        return "its gap rests on an assumption about ordinary driving, and the profile makes none ([driving])"
    if any(statements.assumption(profile.driving) not in line for line in rests):
        return f"its gap rests on another assumption than the profile's: {statements.assumption(profile.driving)}"
    return ""


def facts(certificate: Certificate) -> CertificateFacts:
    """What the gate compares."""
    return CertificateFacts(
        id=certificate.id,
        controller_digest=certificate.controller_digest,
        model_digest=certificate.model_digest,
        task_digest=certificate.task_digest,
        profile_digest=certificate.profile_digest,
        epoch=certificate.gap.epoch,
        radius=certificate.gap.radius,
        verified_radius=certificate.verified_radius,
        issued_unix_s=certificate.issued_unix_s,
        expires_unix_s=certificate.expires_unix_s,
        attempt=certificate.verification.attempt,
        fixed_seed=certificate.tries is not None and certificate.tries.fixed,
    )


def _content(certificate: Certificate) -> bytes:
    """Canonical bytes as they are after reading them again: `1` in a place for a float is `1.0`."""
    return canonical(_plain(msgspec.json.decode(canonical(certificate), type=Certificate)))


def _file(signed: _Signed) -> bytes:
    return canonical({**msgspec.to_builtins(signed), "certificate": _plain(signed.certificate)})


def _plain(certificate: Certificate) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(certificate)
    if certificate.tries is None:
        del plain["tries"]
    if certificate.runs is None:
        del plain["runs"]
    if certificate.composition is None:
        del plain["composition"]
    return plain


def _decode(data: bytes, where: str) -> _Signed:
    try:
        return msgspec.json.decode(data, type=_Signed)
    except (ValueError, RecursionError) as error:  # msgspec's and Unicode's are ValueErrors
        reason = str(error)
    schema = _schema(data)
    if schema is not None and schema != SCHEMA:
        raise ConfigError(f"{where}: has certificate schema {schema}, this version reads {SCHEMA}")
    raise ConfigError(f"{where}: is no certificate, or was changed after it was signed: {reason}")


def _schema(data: bytes) -> Any:
    try:
        return msgspec.json.decode(data)["certificate"]["schema"]
    except (ValueError, RecursionError, KeyError, TypeError):
        return None


def _check_content(c: Certificate, now_unix_s: int | None, where: str) -> None:
    if c.schema != SCHEMA:
        raise ConfigError(f"{where}: has certificate schema {c.schema}, this version reads {SCHEMA}")
    for what, ok in _bindings(c):
        if not ok:
            raise ConfigError(f"{where}: {what}")
    if now_unix_s is None:
        return
    if now_unix_s >= c.expires_unix_s:
        raise ConfigError(f"{where}: expired {now_unix_s - c.expires_unix_s} s ago; certify again")
    if now_unix_s < c.issued_unix_s - CLOCKS_APART_S:
        raise ConfigError(f"{where}: was issued {c.issued_unix_s - now_unix_s} s from now by this clock, so one of the clocks is wrong")


def _bindings(c: Certificate) -> list[tuple[str, bool]]:
    """(what would be wrong, whether it is right): that the parts are of one controller, model, task."""
    v = c.verification
    return [
        ("its controller digest is not that of its controller", c.controller_digest == c.controller.digest()),
        ("the verification is of another controller", v.controller_digest == c.controller_digest),
        ("its model digest is not that of its model", c.model_digest == c.model.digest()),
        ("the gap is of another model", c.gap.model_digest == c.model_digest),
        ("the verification is of another model", v.model_digest == c.model_digest),
        ("the verification is of another task", v.task_digest == c.task_digest),
        ("what was tried is not of this attempt", c.tries is None or (c.tries.attempts == v.attempt and c.tries.on_gap >= 1)),
        ("its verified radius is not that of the verification", c.verified_radius == v.radius and c.verified_hold_radius == v.hold_radius),
        (
            "the trials are of another controller, task or model",
            c.trials is None
            or (c.trials.controller_digest, c.trials.task_digest, c.trials.model_digest)
            == (c.controller_digest, c.task_digest, c.model_digest),
        ),
        ("the enclosure is of another controller, model or task", c.composition is None or _is_of(c.composition, c)),
        ("it expires before it is issued", c.issued_unix_s < c.expires_unix_s),
    ]


def _is_of(composition: Composition, c: Certificate) -> bool:
    e = composition.enclosure
    return (e.controller_digest, e.model_digest, e.task_digest) == (c.controller_digest, c.model_digest, c.task_digest)


def _asked_for(profile: Profile, gap: Gap, v: Verification) -> list[tuple[str, bool]]:
    """As `_bindings`: that gap and verification are what the profile asks for."""
    required = {law.law for law in v.laws if law.required}
    return [
        (
            "the gap's epsilon is above the profile's",
            gap.epsilon <= profile.guarantee.epsilon,
        ),
        ("the gap's set or discards are not the profile's", gap.set == profile.norm.set and gap.discarded == profile.guarantee.discard),
        ("the verification's epsilon is above the profile's", v.epsilon <= profile.verification.epsilon),
        ("the verification's threshold is below the profile's", v.threshold >= profile.verification.threshold),
        ("a disturbance law that the profile requires is not among the verification's", required >= set(profile.verification.required)),
    ]


def _composed_for(profile: Profile, c: Certificate) -> list[tuple[str, bool]]:
    """As `_asked_for`, of a composed statement."""
    if c.composition is None:
        return []
    enclosure, runs = c.composition.enclosure, c.composition.runs
    most = share(profile.guarantee.beta_composition, c.verification.attempt) * (1.0 + 1e-9)
    return [
        ("the composed statement is of another radius than verification.run_radius", enclosure.radius == profile.verification.run_radius),
        (
            "the composed statement spends more than its attempt's share of guarantee.beta_composition",
            max(enclosure.beta, runs.beta if runs is not None else 0.0) <= most,
        ),
    ]


def _evidence(c: Certificate, *, traced_not_adopted: bool) -> list[tuple[str, bool, int]]:
    """(what is lacking, whether it is there, how many samples more would do)."""
    gap, v = c.gap, c.verification
    required = [law for law in v.laws if law.required]
    alone = {law.law for law in required} == {"uniform"}
    slack = 1.0 + 1e-9  # of the last digits in which a share is computed
    holds = gap.hold_periods > 1
    least_n = min((law.n for law in required), default=0)
    assumed = any(statements.ASSUMED in line for line in c.shown)  # half of the share pays for the mixing (`blocked`)
    halved = holds or assumed
    wrong = ""
    if c.composition is not None:
        from s2r_runtime.evidence.composition import problem  # numpy, which the gate's process does without

        wrong = problem(c.composition)
    wanted_n = campaign_size(gap.epsilon, gap.beta, gap.discarded) if halved else sample_size(gap.epsilon, gap.beta, gap.discarded)
    return [
        ("the controller did not pass verification" + (f": {v.reason}" if v.reason else ""), v.passed, 0),
        ("no disturbance law was required", bool(required), 0),
        ("a required law was not passed", all(law.passed and law.progress_ok and law.s_star >= v.threshold for law in required), 0),
        ("the verified radius is below the gap", v.radius >= gap.radius and (not holds or v.hold_radius >= gap.hold_radius), 0),
        ("the gap spends more than its epoch's share of beta", gap.beta <= share(c.budget, gap.epoch) * slack, 0),
        ("the verification spends more than its attempt's share of beta", v.beta <= share(c.budget, v.attempt) * slack, 0),
        (f"the samples were not drawn independently: {gap.white_reason}", not gap.white_reason.startswith(NOT_INDEPENDENT), 0),
        (
            f"{gap.n} samples do not carry the gap's statement",
            binomial_tail(gap.n, gap.discarded, gap.epsilon) <= gap.beta / (2.0 if halved else 1.0) * slack,
            wanted_n - gap.n,
        ),
        (
            f"{least_n} scenarios do not carry the verification's statement",
            v.split >= 1 and binomial_tail(least_n, 0, v.epsilon) <= v.beta / v.split * slack,
            sample_size(v.epsilon, v.beta / max(v.split, 1)) - least_n,
        ),
        (
            "only the law uniform was required, and the residual is not white" + (f": {gap.white_reason}" if gap.white_reason else ""),
            gap.white or not alone,
            0,
        ),
        ("the trials do not carry their statement", c.trials is None or _carried(c.trials, slack), 0),
        ("the limits of its runs do not follow from their counts", c.runs is None or _follow(c.runs), 0),
        (
            "the composed statement does not follow from its numbers" + (f": {wrong}" if wrong else ""),
            not wrong,
            0,
        ),
        ("only the law uniform was required, and an effect was traced that the model lacks", not (alone and traced_not_adopted), 0),
    ]


def _follow(runs: RunLimits) -> bool:
    """Whether these are the limits of the counts at their shares (guarantee G10)."""
    if not (0 <= runs.unsafe <= runs.n - runs.censored and runs.censored >= 0 and min(runs.beta_lower, runs.beta_upper) > 0.0):
        return False
    if not max(runs.beta_lower, runs.beta_upper) < 1.0:
        return False
    again = anytime.limits(anytime.Counts(runs.n, runs.unsafe, runs.censored), runs.beta_lower, runs.beta_upper)
    return math.isclose(again.lower, runs.lower, abs_tol=1e-9) and math.isclose(again.upper, runs.upper, abs_tol=1e-9)


def _carried(trials: Trials, slack: float) -> bool:
    """Whether the numbers of trials are bounds at their beta (guarantee G9)."""
    if not (0 <= trials.unsafe <= trials.n and trials.beta < 1.0 and trials.radius >= 0.0):
        return False  # without a run, or with a beta of 0, no tail below is small enough
    if trials.unsafe == trials.n:
        unsafe = trials.unsafe_upper == 1.0  # no smaller bound is one
    else:
        unsafe = 0.0 < trials.unsafe_upper < 1.0 and binomial_tail(trials.n, trials.unsafe, trials.unsafe_upper) <= trials.beta * slack
    if trials.simulated is not None and not _simulated_fit(trials.simulated, trials.n):
        return False
    return unsafe and 0.0 < trials.epsilon < 1.0 and binomial_tail(trials.n, 0, trials.epsilon) <= trials.beta * slack


def _simulated_fit(found: Simulated, n: int) -> bool:
    """Whether means with simulation and optimism are of these runs, and within their ranges (guarantee G11, G12)."""
    mean, optimism, spread = found.mean, found.optimism, found.high - found.low
    ordered = found.low <= mean.lower <= mean.upper <= found.high and -spread <= optimism.lower <= optimism.upper <= spread
    return mean.n == optimism.n == n and found.rollouts >= 1 and ordered and 0.0 < mean.beta < 1.0 and 0.0 < optimism.beta < 1.0
