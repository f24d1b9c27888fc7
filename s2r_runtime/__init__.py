"""Embedded runtime assurance for robots."""

import sys

from s2r_runtime.moved import MovedModules

sys.meta_path.insert(0, MovedModules())
