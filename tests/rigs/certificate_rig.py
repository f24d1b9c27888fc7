"""Evidence of a small campaign and verification, for tests of certificates."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.core.ledger import campaign_size, sample_size, share
from s2r_runtime.messages import Gap, LawResult, Verification
from s2r_runtime.profile import Profile, parse_profile
from s2r_runtime.trust import certificate, keys
from s2r_runtime.trust.certificate import Certificate

PROFILE = """
[robot]
name = "rover"
[model]
name = "unicycle"
dt = 0.033
[[model.effects]]
name = "input_delay"
channel = "*"
parameters = { delay = 0.033 }
[region]
x = [-1.6, 1.6]
y = [-1.0, 1.0]
[inputs]
v = [-0.2, 0.2]
w = [-3.1, 3.1]
[norm]
weights = { theta = 0.0525 }
[guarantee]
epsilon = 0.03
beta = 0.05
[verification]
epsilon = 0.03
[task]
name = "grid_world"
parameters = { static = 8 }
[transport]
name = "zenoh"
"""

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))

PUBLIC = keys.public_bytes(KEY)

NOW = 1_800_000_000


@dataclass
class Evidence:
    """Everything that `issue` takes; tests change a part of it."""

    profile: Profile
    controller: ControllerFile
    gap: Gap
    verification: Verification

    def issue(self, **more: Any) -> Certificate:
        given = {"lifetime_s": 3600, "horizon": 200, **more}
        return certificate.issue(
            profile=self.profile, controller=self.controller, gap=self.gap, verification=self.verification, issued_unix_s=NOW, **given
        )

    def with_gap(self, **changes: Any) -> Evidence:
        return Evidence(self.profile, self.controller, msgspec.structs.replace(self.gap, **changes), self.verification)

    def with_verification(self, **changes: Any) -> Evidence:
        return Evidence(self.profile, self.controller, self.gap, msgspec.structs.replace(self.verification, **changes))

    def with_laws(self, *names: str, required: tuple[str, ...], **changes: Any) -> Evidence:
        text = PROFILE.replace("[task]", f"laws = {json.dumps(names)}\nrequired = {json.dumps(required)}\n[task]")
        profile = parse_profile(text, "test.toml", Path())
        laws = tuple(msgspec.structs.replace(law(name, required=name in required), **changes) for name in names)
        return Evidence(profile, self.controller, self.gap, msgspec.structs.replace(self.verification, laws=laws))


def law(name: str, *, required: bool = True) -> LawResult:
    return LawResult(name, 139, 0.25, 0, 0.0297, 0.9, progress_ok=True, required=required, passed=True)


def evidence() -> Evidence:
    profile = parse_profile(PROFILE, "test.toml", Path())
    controller = ControllerFile(
        path="grid.py",
        source=b"def control(x, theta, parameters): ...",
        parameters={"speed": 0.15, "levels": [1, 2.5], "name": "calm"},
        modules={"maps": b"GRID = 8"},
        libraries={"numpy": "2.4.6"},
        python="CPython 3.11.7",
    )
    beta = share(0.05, 1)
    gap = Gap(
        radius=0.004,
        radius_literal=0.05,
        hold_radius=0.03,
        hold_periods=50,
        set="ball",
        weights=(1.0, 1.0, 0.0525),
        n=campaign_size(0.03, beta, 0),
        discarded=0,
        epsilon=0.03,
        beta=beta,
        epoch=1,
        model_digest=profile.model.digest(),
        transitions_digest="sha256:" + "ab" * 32,
        rejected={"out_of_region": 4},
        radius_noise=0.002,
    )
    verification = Verification(
        passed=True,
        radius=0.006,
        hold_radius=0.045,
        threshold=0.0,
        epsilon=0.03,
        beta=share(0.05, 2),
        attempt=2,
        seed=2**47 + 1,
        laws=(law("uniform"), law("persistent"), law("adversarial", required=False)),
        controller_digest=controller.digest,
        model_digest=profile.model.digest(),
        task_digest=profile.task_digest(),
    )
    laws = tuple(msgspec.structs.replace(one, n=sample_size(0.03, verification.beta)) for one in verification.laws)
    return Evidence(profile, controller, gap, msgspec.structs.replace(verification, laws=laws))
