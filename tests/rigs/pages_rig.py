"""Pages in headless Chromium."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


def rendered(page: Path, tmp_path: Path, *flags: str) -> str:
    """The page's DOM after Chromium has laid it out."""
    assert CHROMIUM is not None
    done = subprocess.run(
        [CHROMIUM, *FLAGS, *flags, f"--user-data-dir={tmp_path / 'chromium'}", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def self_contained(text: str) -> None:
    """No script, and no address that a browser would fetch: a picture is in the page itself."""
    assert "<script" not in text
    assert re.findall(r"""(?:src|href)\s*=\s*["'](?!#|data:image/png;base64,\w)[^"']+""", text) == []
    assert re.findall(r"url\((?!#)[^)]*\)", text) == []
