"""How the parts of a run follow each other and end, and what a log says of what it lacks."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from s2r_runtime.audit.findings import Findings
from s2r_runtime.recording.channels import LogDeleted, Unrecorded
from s2r_runtime.recording.layout import RECOVERED
from s2r_runtime.recording.reading import Reading


def continues(before: Reading | None, reading: Reading, findings: Findings) -> bool:
    """Whether a part goes on where the one before ended."""
    after = 0 if before is None else before.part
    if reading.part > after + 1:
        which = ", ".join(map(str, range(after + 1, reading.part)))
        several = "parts" if reading.part > after + 2 else "part"
        findings.incomplete_input(f"{several} {which} of run {reading.run} ({reading.path.name} is part {reading.part})")
        return False
    if before is None:
        return True
    if reading.public_key != before.public_key:
        findings.cannot(f"{reading.path.name} is of another key than {before.path.name}, the part before it")
        return False
    if reading.previous_head != before.head or reading.first_index != before.ending.index:
        findings.differ(reading.first_index, "log/chain", "this part does not continue the one before", reading.previous_head, before.head)
        return False
    return True


def ended(reading: Reading, findings: Findings) -> bool:
    """Notes how a file ended; whether a next part can go on from it."""
    end = reading.ending
    if end.kind == "broken":
        findings.differ(end.index, "log/chain", f"the log is damaged: {end.detail}", None, None)
    elif end.kind == "cut":
        lost = f" ({end.lost_bytes} bytes could not be used)" if end.lost_bytes else ""
        what = "nothing but the index" if reading.sealed_for_good else "what came after"
        if (known := reading.metadata.get(RECOVERED)) is not None:
            told = known.get("missing", "nothing, says the recovery")
            findings.lack(f"{reading.path.name} was recovered; it lacks, as the recovery says and nothing vouches for: {told}")
            return reading.sealed_for_good
        findings.lack(f"{what}: {reading.path.name} was cut after {end.index} messages: {end.detail}{lost}")
    return end.kind == "rotated" or (end.kind == "cut" and reading.sealed_for_good)


def anchored(readings: Sequence[Reading], heads: Sequence[bytes], findings: Findings) -> None:
    """Every head that was published must be one that the chain came by: it was on the disk when it was published."""
    met = set[bytes]().union(*(reading.met for reading in readings))
    last = readings[-1]
    for head in heads:
        if head not in met:
            findings.file = last.path.name
            if findings.incomplete:
                findings.incomplete_input(f"the part that has the published head {head.hex()}, if any has it")
                continue
            what = "the log does not come to a head that was published: its tail was cut off, or it is another log"
            findings.differ(last.ending.index, "log/chain", what, last.head.hex(), head.hex())
        else:
            findings.count("published heads")


def unrecorded(message: msgspec.Struct, findings: Findings) -> None:
    """Takes what the log says it lacks: messages that could not be written (`log/unrecorded`)."""
    assert isinstance(message, Unrecorded)  # noqa: S101 - the channel's type
    findings.lack(f"{message.count} messages at the end were not recorded: {message.reason}")


def deleted(message: msgspec.Struct, findings: Findings) -> None:
    """Takes the name of a run whose log was deleted to make room (`log/deleted`): it was there, and is not any more."""
    assert isinstance(message, LogDeleted)  # noqa: S101 - the channel's type
    head = f" (head {message.head})" if message.head else ""
    findings.lack(f"the log of run {message.run}{head}, which the daemon deleted: {message.reason}")
