"""The notebooks of `examples/` run from the first cell to the last, in a kernel of their own."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
WITHIN_S = 300

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]


def run(notebook: Path, folder: Path, first: str = "") -> list[dict[str, Any]]:
    """Outputs of all cells. first: code of a cell before them."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    book = nbformat.read(notebook, as_version=4)
    nbformat.validate(book)
    assert all(not cell.get("outputs") for cell in book.cells), "a notebook is stored without outputs"
    book.cells.insert(0, nbformat.v4.new_code_cell(first))
    client = nbclient.NotebookClient(book, timeout=WITHIN_S, kernel_name="python3", resources={"metadata": {"path": str(folder)}})
    return [output for cell in client.execute().cells for output in cell.get("outputs", [])]


def shown(outputs: list[dict[str, Any]]) -> str:
    """Text and HTML of all outputs."""
    found = [output.get("text", "") + "".join(str(text) for text in output.get("data", {}).values()) for output in outputs]
    return "\n".join(found)


def test_every_notebook_has_a_test() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["read_log", "trace_motor"]


def test_a_motor_is_traced(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    outputs = run(ROOT / "examples" / "notebooks" / "trace_motor.ipynb", tmp_path / "examples" / "notebooks")
    text = shown(outputs)
    assert "traced: the model lacks 2 effects" in text
    assert "coulomb_friction" in text
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3


def test_a_daemons_log_is_read(tmp_path: Path) -> None:
    from audit_bench import Bench

    (tmp_path / "bench").mkdir()
    Bench(tmp_path / "bench").sample().drive(60).stop().write(tmp_path / "run.mcap")
    with_the_transport_of_the_log = f"import sys; sys.path[:0] = [{str(ROOT / 'tests' / 'rigs')!r}]; import audit_bench"
    outputs = run(ROOT / "examples" / "notebooks" / "read_log.ipynb", tmp_path, with_the_transport_of_the_log)
    text = shown(outputs)
    assert "event/observed" in text
    assert "holds: " in text
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
