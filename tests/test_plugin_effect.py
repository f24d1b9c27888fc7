"""What the page for plug-in authors promises of an effect: its length, its kit, and that the tracer finds it once it is installed."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "plugin-author.md").read_text(encoding="utf-8")
SECTION = PAGE[PAGE.index("## A complete effect") : PAGE.index("## A model of your own")]
EFFECT, KIT, ON_A_BASE, *_OTHERS = re.findall(r"^```python[^\n]*\n(.*?)^```$", SECTION, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder on the path with the page's effect in a package of its own, as an installer leaves it."""
    place = tmp_path_factory.mktemp("site")
    package, metadata = place / "my_package", place / "my_effects-1.0.dist-info"
    package.mkdir()
    metadata.mkdir()
    (package / "__init__.py").write_text("")
    (package / "effect.py").write_text(EFFECT, encoding="utf-8")
    offer = re.search(r"`(Offer\(.*?\))`", SECTION)
    assert offer is not None
    (package / "plugin.py").write_text(
        f"from s2r_runtime.hookspecs import Offer, hookimpl\n\n\n@hookimpl\ndef s2r_effects():\n    return [{offer.group(1)}]\n",
        encoding="utf-8",
    )
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-effects\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[s2r_runtime]\nmy_effects = my_package.plugin\n")
    (place / "test_mine.py").write_text(KIT, encoding="utf-8")
    return place


def _run(installed: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": f"{installed}{os.pathsep}{ROOT}", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *words], cwd=installed, env=environment, capture_output=True, text=True, timeout=110, check=False
    )


def test_an_effect_takes_less_than_forty_lines() -> None:
    assert "less than 40 lines" in SECTION
    assert len(EFFECT.splitlines()) < 40


@pytest.mark.slow
def test_the_example_passes_the_kit_in_the_lines_that_the_page_shows(installed: Path) -> None:
    done = _run(installed, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_mine.py")
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


@pytest.mark.slow
def test_an_effect_on_a_base_passes_the_kit_as_the_page_shows_it(installed: Path) -> None:
    kit = (
        "from s2r_runtime.testing import EffectKit\n\n\nclass TestSoftLimit(EffectKit):\n    effect, parameters = SoftLimit(), {'k': 0.5}\n"
    )
    (installed / "test_soft.py").write_text(f"{ON_A_BASE}\n\n{kit}", encoding="utf-8")
    done = _run(installed, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_soft.py")
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


@pytest.mark.slow
def test_an_installed_effect_is_listed_and_found_by_the_tracer_by_its_name(installed: Path, tmp_path: Path) -> None:
    rng, dt = np.random.default_rng(3), 0.05
    u = np.repeat(rng.uniform(-2.0, 2.0, (60, 2)), 15, axis=0)
    x, rows = np.zeros(3), []
    for v, w in u:
        measured = x + rng.normal(size=3) * [0.001, 0.001, 0.003]
        rows.append([len(rows) * dt, *measured, v, w])
        x = x + dt * np.array([v * np.cos(x[2]), v * np.sin(x[2]), w + 0.05 * w**3])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="t,x,y,theta,v,w", comments="", fmt="%.9g")
    listed = _run(installed, "-m", "s2r_runtime.cli.main", "plugin", "list")
    assert "my_bent_response" in listed.stdout, listed.stderr
    done = _run(
        installed, "-m", "s2r_runtime.cli.main", "trace", str(tmp_path / "run.csv"), "--model", "unicycle", "--dt", str(dt), "--json"
    )
    found = json.loads(done.stdout)
    (effect,) = found["effects"]
    assert (found["verdict"], effect["name"], effect["channel"]) == ("traced", "my_bent_response", "w")
    bend = effect["parameters"]["bend"]
    assert bend["low"] <= 0.05 <= bend["high"]
    assert bend["unit"] == "1/(rad/s)²"
