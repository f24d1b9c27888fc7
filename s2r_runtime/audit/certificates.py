"""Holds every certificate against what the log shows: signature, bindings, evidence, and the very sentences (docs/guarantee.md, 5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.audit.evidence import Evidence, attached_controller
from s2r_runtime.audit.findings import CertificateFinding, Findings
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.messages import FIXED_SEEDS, CertificateFacts, CertificateStored, IssueCertificate, Memory, Revoked, Settings
from s2r_runtime.profile import Profile
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Entry
from s2r_runtime.trust import certificate as certificates
from s2r_runtime.trust import keys

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.trust.certificate import Certificate
    from s2r_runtime.trust.revocations import Revocation


CLOCK_S = 60
"""By which a certificate's time of issue may differ from the newest reading of the wall clock; readings come every second."""


class Certificates:
    """Of all runs."""

    def __init__(self, findings: Findings, evidence: Evidence, revoked: Mapping[str, Revocation] | None = None) -> None:
        """revoked: keys that are not believed, by fingerprint."""
        self._findings, self._evidence, self._revoked = findings, evidence, revoked or {}
        self._orders: dict[int, tuple[IssueCertificate, bool]] = {}
        self._facts: dict[str, CertificateFacts] = {}

    def begin_run(self) -> None:
        """A new run numbers its requests anew."""
        self._orders.clear()

    def remembered(self, entry: Entry, memory: Memory) -> None:
        """A run begins with these certificates in force: those that earlier logs stored must be the same."""
        for facts in memory.certificates:
            known = self._facts.setdefault(facts.id, facts)
            if known != facts:
                self._findings.differ(entry.index, entry.channel, f"the memory has another certificate {facts.id}", facts, known)
            if facts.id not in self._findings.certificates:
                self._findings.lack(f"the evidence of certificate {facts.id}, in an earlier log that was not given")

    def issuing(self, order: IssueCertificate, *, traced: bool) -> None:
        """The core has a certificate signed."""
        self._orders[order.request_id] = (order, traced)

    def stored(
        self,
        entry: Entry,
        event: CertificateStored,
        profile: Profile,
        settings: Settings,
        horizon: Callable[[], int],
        attachments: Mapping[str, Attached],
        trusted: tuple[bytes, ...],
        unix_s: int,
    ) -> None:
        """A certificate is in force. trusted: keys whose signature counts; the log's own first. unix_s: the log's wall clock."""
        identity = event.facts.id
        self._facts[identity] = event.facts
        try:
            note = self._judged(event, profile, settings, horizon, attachments, trusted, unix_s)
            valid = True
        except (ConfigError, NotEnoughEvidence) as error:
            note, valid = str(error), False
        self._findings.certificates[identity] = CertificateFinding(identity, valid, note)
        if not valid:
            self._findings.differ(entry.index, entry.channel, f"certificate {identity}: {note}", event.facts, None)

    def revoked(self, output: Revoked) -> None:
        """It was withdrawn; what it said when it was issued stays as true as it was."""
        finding = self._findings.certificates.get(output.certificate_id)
        if finding is not None:
            finding.reason += f"; revoked later: {output.reason}"

    def _judged(
        self,
        event: CertificateStored,
        profile: Profile,
        settings: Settings,
        horizon: Callable[[], int],
        attachments: Mapping[str, Attached],
        trusted: tuple[bytes, ...],
        unix_s: int,
    ) -> str:
        """Why it stands. Raises ConfigError with why it doesn't."""
        certificate, signer = self._signed(event, attachments, trusted, settings.rules)
        if problem := certificates.assumption_problem(certificate, profile):
            raise ConfigError(problem)
        if event.gap is not None:
            known = "a trusted key" if signer in trusted else f"key {keys.fingerprint(signer)}, not compared with a trusted one"
            self._findings.lack(f"the evidence of certificate {event.facts.id}, which was made elsewhere")
            return f"signed elsewhere by {known}; its evidence is not in this log"
        order, traced = self._orders.get(event.request_id, (None, False))
        if order is None:
            raise ConfigError("nobody asked for it")
        if problem := self._evidence.problem(order):
            raise ConfigError(problem)
        controller = attached_controller(attachments, certificate.controller_digest)
        self._compared(certificate, order, controller, profile, settings, horizon, unix_s, traced)
        self._findings.count("certificates")
        return self._evidence.support(order)

    def _signed(
        self, event: CertificateStored, attachments: Mapping[str, Attached], trusted: tuple[bytes, ...], rules: int
    ) -> tuple[Certificate, bytes]:
        """The attached certificate, which says what the gate was told, and the public key that signed it. Raises ConfigError.

        One that was made elsewhere may have any signer, who is named; one of this daemon's has its key.
        """
        data = attachments.get(f"certificate/{event.facts.id}")
        if data is None:
            raise ConfigError("is not attached to the log")
        signer = certificates.signer(data.data)
        if (revocation := self._revoked.get(keys.fingerprint(signer))) is not None:
            raise ConfigError(f"is signed with the key {keys.fingerprint(signer)}, which was {revocation}")
        believed = {*trusted, signer} if event.gap is not None else trusted[:1]
        certificate = certificates.load(data.data, believed, None, "certificate")
        facts = certificates.facts(certificate)
        if rules < FIXED_SEEDS:  # the gate received less then
            facts = msgspec.structs.replace(facts, fixed_seed=False)
        if facts != event.facts or event.gap not in (None, certificate.gap):
            raise ConfigError("what the gate was told is not what it says")
        return certificate, signer

    @staticmethod
    def _compared(
        certificate: Certificate,
        order: IssueCertificate,
        controller: ControllerFile | None,
        profile: Profile,
        settings: Settings,
        horizon: Callable[[], int],
        unix_s: int,
        traced: bool,
    ) -> None:
        """Issues it once more from what was ordered. Raises ConfigError if that is another one."""
        if controller is None:
            raise ConfigError("the controller that it is of is not attached")
        if certificate.profile_digest != settings.profile_digest:
            raise ConfigError("it is of another profile")
        if abs(certificate.issued_unix_s - unix_s) > CLOCK_S:
            raise ConfigError(f"it says that it was issued at {certificate.issued_unix_s} s, and the log's clock was at {unix_s} s")
        again = certificates.issue(
            profile=profile,
            controller=controller,
            gap=order.gap,
            verification=order.verification,
            issued_unix_s=certificate.issued_unix_s,
            lifetime_s=order.lifetime_s,
            horizon=horizon(),
            traced_not_adopted=traced,
            tries=order.tries,
            runs=order.run_limits,
        )
        if again.id != certificate.id:
            raise ConfigError("what it says is not what the evidence says")
