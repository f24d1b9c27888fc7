"""`python -m s2r_runtime` is `s2r`."""

import sys

from s2r_runtime.cli.main import entry

sys.exit(entry())
