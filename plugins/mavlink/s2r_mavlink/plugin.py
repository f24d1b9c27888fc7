"""What this package offers."""

from __future__ import annotations
