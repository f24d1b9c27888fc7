"""Recomputes a log from itself: chain and signatures, frames, the core, discrepancies, campaigns, gaps, verifications, certificates.

Nothing in the log is taken for true that follows from something else in it. What does not follow is what came from outside: the
frames' bytes, the clock, what people asked for, what a controller answered; those are vouched for by the chain alone. One pass,
constant memory but for attachments and campaign samples.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.audit.ahead import Ahead
from s2r_runtime.audit.beside import Beside
from s2r_runtime.audit.campaign import CampaignReplay
from s2r_runtime.audit.certificates import Certificates
from s2r_runtime.audit.endings import anchored, continues, deleted, ended, unrecorded
from s2r_runtime.audit.evidence import Evidence
from s2r_runtime.audit.findings import CertificateFinding, Difference, Findings, ModelFinding
from s2r_runtime.audit.run import Across, RunAudit
from s2r_runtime.audit.traces import SECONDS, Traces
from s2r_runtime.errors import NotEnoughEvidence, RecordingError
from s2r_runtime.files.printable import printable
from s2r_runtime.recording.blocks import find
from s2r_runtime.recording.channels import DELETED, UNRECORDED
from s2r_runtime.recording.layout import ABOUT
from s2r_runtime.recording.logs import is_log, runs
from s2r_runtime.recording.reading import Entry, Reading
from s2r_runtime.recording.writer import environment
from s2r_runtime.trust import keys
from s2r_runtime.trust.revocations import Revocation

COLLECT_EVERY = 20_000
"""Objects made beyond those that are gone again, between two searches for cycles: some MB."""
OWN = frozenset((UNRECORDED, DELETED))
PROGRESS_EVERY = 2000
"""Messages between two looks at how far it is."""
MACHINE = "cpu"
"""With the same platform and processor, so must those be that a fit came to by many steps of arithmetic."""
PLATFORM = ("python", "platform", "byteorder", "version.numpy", "version.scipy", "version.s2r-runtime")
"""Where these are the same, numbers must be identical."""


class AuditResult(msgspec.Struct, frozen=True):
    """What an audit says (docs/json.md).

    `ok`: everything that is there was recomputed and holds. `chain`: intact, broken or unsigned tail. `recomputed`: how many of what.
    `unchecked`: what could not be recomputed here, and why: then it is not ok. `incomplete`: parts that were not given, without which the
    rest can't be recomputed: then it is not ok either, and `only_incomplete` if that is all. `skipped`: what was not recomputed, because it
    takes long: neither passed nor failed. `models`: those that were put in force. `signed_by`: the key, and whether it was asked for.
    `head`: of the chain, to compare with what the daemon printed.
    """

    ok: bool
    records: int
    certificates: list[CertificateFinding]
    first_difference: Difference | None
    differences: int
    missing: list[str]
    chain: str
    signed_by: str
    head: str
    recomputed: dict[str, int]
    unchecked: list[str]
    files: list[str]
    skipped: list[str] = []
    models: list[ModelFinding] = []
    incomplete: list[str] = []
    only_incomplete: bool = False

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain

    def text(self) -> str:
        """For people."""
        answer = "holds" if self.ok else "INCOMPLETE INPUT" if self.only_incomplete else "DOES NOT HOLD"
        lines = [f"{answer}: {self.records} records in {', '.join(self.files)}"]
        lines.append(f"chain        {self.chain}; {self.signed_by}; head {self.head}")
        if self.first_difference is not None:
            d = self.first_difference
            lines.append(f"differs      {self.differences} times, first at record {d.index} ({d.channel}) of {d.file}: {d.what}")
            lines += [f"  recorded   {d.recorded}", f"  recomputed {d.recomputed}"]
        lines += [f"not given    {one}; give all parts of the run" for one in self.incomplete]
        lines += [f"missing      {one}" for one in self.missing]
        lines += [f"unchecked    {one}" for one in self.unchecked]
        lines += [f"skipped      {one}" for one in self.skipped]
        lines += [f"model        {one.digest}: adopted by {one.adopted_by}: {one.origin}" for one in self.models]
        lines += [f"certificate  {one.id}: {'valid' if one.valid else 'NOT VALID'}: {one.reason}" for one in self.certificates]
        lines.append("recomputed   " + (", ".join(f"{count} {what}" for what, count in self.recomputed.items()) or "nothing"))
        return "\n".join(map(printable, lines))


def audit(
    paths: Sequence[Path],
    public_key: bytes | None = None,
    rerun_controllers: bool = False,
    rerun_traces: bool = False,
    heads: Sequence[bytes] = (),
    revoked: Mapping[str, Revocation] | None = None,
    progress: Callable[[float, float, str], None] | None = None,
) -> AuditResult:
    """Audits the files of one or more runs of a robot. public_key: the Ed25519 key that must have signed them, 32 bytes.

    rerun_controllers: run the attached controllers' code, confined, to repeat the verifications. rerun_traces: run traces again however
    long they take (else those that are done within `traces.SECONDS`). heads: that the daemon published: the logs must reach them.
    revoked: keys that are not believed, by fingerprint.
    progress: (done, total, what).
    Raises RecordingError for a file that is no log, NotEnoughEvidence if no record can be read,
    ConfigError or PluginError where this machine lacks what the log needs.
    """
    findings = Findings()
    tell = _Progress(paths, progress)
    trusted = () if public_key is None else (public_key,)
    traces = Traces(findings, seconds=None if rerun_traces else SECONDS, progress=tell.detail)
    evidence = Evidence(findings, traces, rerun=rerun_controllers, progress=tell.detail)
    beside = Beside(findings)
    certificates = Certificates(findings, evidence, revoked)
    across = Across(findings, CampaignReplay(findings), evidence, certificates, traces, beside, trusted, rerun_controllers)
    try:
        grouped = runs(paths)
    except RecordingError as error:
        return _damaged(paths, error)
    findings.files = [reading.path.name for parts in grouped for reading in parts]
    readings = [reading for parts in grouped for reading in parts]
    for reading in readings:
        reading.sought = frozenset(heads)
    with _few_collections(), contextlib.closing(Ahead(readings)) as ahead, contextlib.closing(beside):
        for parts in grouped:
            _run(RunAudit(across), parts, ahead, findings, tell)
        beside.end()
    records = sum(sum(reading.counts.values()) for reading in readings)
    if not records and findings.first is None and _chain(readings) != "broken":
        raise NotEnoughEvidence(f"{', '.join(str(path) for path in paths)}: no record could be read, so there is nothing to audit")
    across.campaigns.end()
    anchored(readings, heads, findings)
    signed_by, trusted_all = _signers(readings, public_key, revoked or {})
    chain = _chain(readings)
    valid = all(one.valid for one in findings.certificates.values())
    good = findings.first is None and not findings.unchecked and chain != "broken" and trusted_all and valid
    return AuditResult(
        ok=good and not findings.incomplete,
        records=records,
        certificates=list(findings.certificates.values()),
        first_difference=findings.first,
        differences=findings.differences,
        missing=findings.missing,
        chain=chain,
        signed_by=signed_by,
        head=readings[-1].head.hex(),
        recomputed=dict(sorted(findings.counts.items())),
        unchecked=list(findings.unchecked),
        files=[reading.path.name for reading in readings],
        skipped=list(findings.skipped),
        models=list(findings.models),
        incomplete=list(findings.incomplete),
        only_incomplete=good and bool(findings.incomplete),
    )


@contextlib.contextmanager
def _few_collections() -> Iterator[None]:
    """Messages are no cycles: looking for some every 700 of them, among all that was imported, takes time and finds nothing."""
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(COLLECT_EVERY, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


def _damaged(paths: Sequence[Path], error: RecordingError) -> AuditResult:
    """What is said of a log whose very start is damaged. Raises the error again if none of the files is one."""
    for path in paths:
        if is_log(path):
            continue
        if not path.is_file():
            raise error
        with path.open("rb") as file:
            if find(file, 0, path.stat().st_size) is None:
                raise error
        where = Difference(path.name, 0, "log/chain", f"the log is damaged: {error}", "nothing", "nothing")
        names = [one.name for one in paths]
        return AuditResult(False, 0, [], where, 1, [], "broken", "whose it is cannot be read", "", {}, [], names)
    raise error


def _run(run: RunAudit, parts: list[Reading], ahead: Ahead, findings: Findings, tell: _Progress) -> None:
    before: Reading | None = None
    lost = False
    for done, reading in enumerate(parts, 1):
        findings.file = reading.path.name
        if not continues(before, reading, findings):
            break
        here = environment()
        told = reading.metadata.get(ABOUT, {})
        findings.same_platform = all(told.get(key) == here.get(key) for key in PLATFORM)
        findings.same_machine = findings.same_platform and bool(told.get(MACHINE)) and told.get(MACHINE) == here.get(MACHINE)
        run.part(reading)
        for number, entry in enumerate(ahead.entries(reading)):
            if lost:
                findings.differ(entry.index, entry.channel, "the log says before that nothing more could be recorded", entry.raw, None)
            if entry.channel not in OWN:
                run.entry(entry)
            else:
                lost |= _about_itself(run, entry, findings)
            if number % PROGRESS_EVERY == 0:
                tell.at(reading)
        tell.over(reading)
        before = reading
        if not ended(reading, findings):
            for left in parts[done:] if reading.ending.kind == "cut" else ():
                findings.cannot(f"{left.path.name} follows a part whose end is missing, so nothing in it could be recomputed")
            break
    else:
        if before is not None and before.ending.kind == "rotated":
            findings.lack(f"what came after {before.path.name}: it goes on in part {before.part + 1}, which was not given")
    last = parts[-1] if before is None else before
    run.end(clean=last.over and last.ending.kind == "closed" and not lost)
    for reading in parts:
        if not reading.over:
            for _ in ahead.entries(reading):
                pass


def _about_itself(run: RunAudit, entry: Entry, findings: Findings) -> bool:
    """What the log says about itself; whether that is that it lacks all that came after."""
    message = entry.message
    if msgspec.json.encode(message) != entry.raw:
        findings.differ(entry.index, entry.channel, "this is not how a recorder writes it", entry.raw, message)
    if entry.channel == UNRECORDED:
        unrecorded(message, findings)
        return True
    run.entry(entry)
    deleted(message, findings)
    return False


def _chain(readings: Sequence[Reading]) -> str:
    states = {reading.chain for reading in readings}
    return next((state for state in ("broken", "unsigned tail") if state in states), "intact")


def _signers(readings: Sequence[Reading], wanted: bytes | None, revoked: Mapping[str, Revocation]) -> tuple[str, bool]:
    """Who signed, in words; and whether that is who was asked for (or nobody was), and nobody who is not believed any more."""
    found = list(dict.fromkeys(reading.public_key for reading in readings))
    names = ", ".join(keys.fingerprint(key) if key else "nobody" for key in found)
    for key in found:
        if key and (revocation := revoked.get(keys.fingerprint(key))) is not None:
            return f"signed by {names}, of which {keys.fingerprint(key)} was {revocation}: nothing shows that this is no forgery", False
    if wanted is None:
        return f"signed by {names}, not compared with a trusted key", True
    if found == [wanted]:
        return f"signed by {names}, the trusted key", True
    return f"signed by {names}, NOT by the trusted key {keys.fingerprint(wanted)}", False


class _Progress:
    """Bytes done of all files."""

    def __init__(self, paths: Sequence[Path], progress: Callable[[float, float, str], None] | None) -> None:
        self._call = progress
        self._total = float(sum(path.stat().st_size for path in paths if path.exists()))
        self._before = self._done = 0.0

    def at(self, reading: Reading) -> None:
        """So far in a file."""
        self._done = self._before + reading.offset
        self.detail("")

    def over(self, reading: Reading) -> None:
        """A file is done."""
        self._before += reading.size

    def detail(self, what: str) -> None:
        """What is done now."""
        if self._call is not None:
            self._call(self._done, self._total, what)
