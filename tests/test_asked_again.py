"""A controller that drives is asked again by a second process, at random: what is no function of its arguments is stopped."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from controllers_rig import Hosted

from s2r_runtime.controllers import asked_again
from s2r_runtime.controllers.asked_again import AskedAgain, Inconsistent
from s2r_runtime.controllers.file import load
from s2r_runtime.controllers.hosted import Reply, Stopped

ASKED = 3000
"""After the change each question is asked again with probability 5 %: 400 of them are enough but for 1e-9."""

TWO_FACED = {
    "counts its calls": "    CALLS.append(1)\n    bad = len(CALLS) > 200\n",
    "remembers what it answered": """
    key = x.tobytes()
    bad = MEMORY.setdefault(key, len(MEMORY) > 200)
""",
    "waits for a time": "    bad = time.monotonic() > LATER\n",
    "draws lots": "    bad = np.random.default_rng().random() < 0.2\n",
    "looks back": "    jump = abs(x[0, 0] - LAST[-1]) > 0.05\n    LAST.append(float(x[0, 0]))\n    bad = not jump and len(LAST) > 200\n",
}


def driven(path: Path) -> Stopped | None:
    """Asked as a robot would ask, along a line; how it was stopped, if it was."""
    it = Hosted(load(path))
    try:
        it.next()
        for k in range(ASKED):
            reply = it.ask((0.001 * k, 0.25, 0.0))
            if isinstance(reply, Stopped):
                return reply
            assert isinstance(reply, Reply)
            time.sleep(0.002)
        return None
    finally:
        it.host.close()


@pytest.mark.slow
@pytest.mark.parametrize("face", TWO_FACED)
def test_a_second_face_is_seen_when_it_shows(tmp_path: Path, face: str) -> None:
    head = "import time\nimport numpy as np\nCALLS, MEMORY, LAST, LATER = [], {}, [0.0], time.monotonic() + 2.0\n"
    body = f"def control(x, theta, parameters):\n{TWO_FACED[face]}"
    answer = "    return np.tile([0.2, 0.0] if bad else [0.05, 0.1], (len(x), 1))\n"
    path = tmp_path / "controller.py"
    path.write_text(head + body + answer, encoding="utf-8")
    stopped = driven(path)
    assert stopped is not None
    assert stopped.reason == "inconsistent"
    assert "asked again about a state of this drive, it answers [0." in stopped.detail


@pytest.mark.slow
def test_a_function_of_its_arguments_drives_on(tmp_path: Path) -> None:
    path = tmp_path / "controller.py"
    path.write_text("import numpy as np\ndef control(x, theta, parameters):\n    return np.sin(x[:, :2])\n", encoding="utf-8")
    assert driven(path) is None


def test_who_has_no_time_to_spare_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1.0]
    monkeypatch.setattr(asked_again, "time", SimpleNamespace(monotonic=lambda: clock[0]))

    def takes_a_millisecond(x: np.ndarray, _theta: object) -> np.ndarray:
        clock[0] += 0.001
        return x[:, :2]

    def asked(gap_s: float) -> None:
        both = AskedAgain(takes_a_millisecond, lambda x, theta: 2.0 * x[:, :2])
        both(np.ones((1, 3)), {})
        for _ in range(1000):
            clock[0] += gap_s
            both(np.ones((1, 3)), {})
            both.check()

    asked(0.002)
    with pytest.raises(Inconsistent, match="no memory, clock or chance"):
        asked(0.005)
