"""A core with a model and a gap."""

from __future__ import annotations

from typing import Any

import msgspec
from core_rig import GAP, S

from s2r_runtime.core import ledger
from s2r_runtime.messages import (
    CertificateFacts,
    CertificateStored,
)


def loaded(epoch: int = 1, transitions: str = "", **changes: Any) -> CertificateStored:
    """Of the gap in force in `memory()`, or of one from a later campaign."""
    transitions = transitions or ("transitions" if epoch == 1 else f"transitions-{epoch}")
    facts = CertificateFacts("offline", "controller", "model", "task", "profile", epoch, 0.01, 0.02, 1500, 2500, 7)
    gap = msgspec.structs.replace(
        GAP, epoch=epoch, transitions_digest=transitions, n=ledger.campaign_size(0.03, ledger.share(0.05, epoch), 0)
    )
    return CertificateStored(S, msgspec.structs.replace(facts, **changes), gap, 5)
