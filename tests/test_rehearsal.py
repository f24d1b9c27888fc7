"""What was verified in batches must be what answers on the robot, one state at a time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worker_rig import GRID, finished, verify_job

from s2r_runtime.controllers.rehearsal import CALLS, Kept
from s2r_runtime.daemon.worker import Failed
from s2r_runtime.errors import ControllerError

CHEATS = {
    "looks at the number of rows": "    if len(x) == 1:\n        return np.tile([0.2, 0.0], (1, 1))\n",
    "counts its calls": "    COUNT.append(1)\n    if len(COUNT) > 50 and len(x) == 1:\n        return np.tile([0.2, 0.0], (1, 1))\n",
    "integrates over what it saw last": "    COUNT.append(float(x[0, 0]))\n    drift = 1e-5 * sum(COUNT)\n",
    "draws lots": "    drift = np.random.normal(0.0, 1e-4)\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("cheat", CHEATS)
def test_a_controller_that_answers_otherwise_alone_gets_no_verdict(tmp_path: Path, cheat: str) -> None:
    honest = GRID.read_text()
    body = honest.replace("def control(", "def honest(")
    path = tmp_path / "cheat.py"
    asked = f"def control(x, theta, parameters):\n    drift = 0.0\n{CHEATS[cheat]}    return honest(x, theta, parameters) + drift\n"
    path.write_text(f"{body}\nCOUNT = []\n\n{asked}")
    said = finished(verify_job(path))[-1]
    assert isinstance(said, Failed), said
    assert "it answers otherwise when it is asked about one state at a time, as on the robot: in step" in said.text


def test_a_function_of_its_arguments_is_the_same_alone() -> None:
    def control(x: np.ndarray, theta: dict[str, np.ndarray]) -> np.ndarray:
        return np.sin(x @ np.ones((3, 2))) * theta["gain"][:, None] + len(theta["name"])

    rng, kept = np.random.default_rng(1), Kept(control)
    for _ in range(CALLS + 3):
        kept(rng.normal(size=(1000, 3)), {"gain": rng.normal(size=1000), "name": "text"})  # type: ignore[dict-item]
    kept.compare(control)
    with pytest.raises(ControllerError, match=r"in step 0 of scenario 0"):
        kept.compare(lambda x, theta: control(x, theta) * (1.0 + 1e-4))
    Kept(control).compare(control)
    single = Kept(control)
    single(rng.normal(size=(1, 3)), {"gain": np.ones(1), "name": "text"})  # type: ignore[dict-item]
    single.compare(control)
