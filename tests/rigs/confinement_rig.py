"""What this machine can confine."""

from __future__ import annotations

import ctypes

LANDLOCK = ctypes.CDLL(None).syscall(444, None, ctypes.c_size_t(0), 1) >= 1
