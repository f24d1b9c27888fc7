"""Tests that wait for robots for minutes begin first, so that the others run beside them; files stay together (see the Makefile).

None of them sees the keys, revocations and state of whoever runs them, nor leaves any there.
"""

import os
import tempfile
from pathlib import Path

LONGEST = (
    "test_demo",
    "test_quadruped_campaign",
    "test_daemon_driving",
    "test_daemon_can",
    "test_daemon_mavlink",
    "test_unsaved_state",
    "test_break_ins",
)


def pytest_collection_modifyitems(items):
    """The longest files first, in the order above; the others as they are."""
    places = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


def pytest_configure(config):
    """A home of its own for every process that runs tests, and for what it starts; and one thread for its linear algebra, as the verbs have
    it: several that wait for each other on two busy cores take many times as long as one.
    """
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
    home = tempfile.TemporaryDirectory(prefix="s2r-tests-home-")
    config.add_cleanup(home.cleanup)
    for name in ("XDG_CONFIG_HOME", "XDG_STATE_HOME"):
        os.environ[name] = str(Path(home.name) / name.lower())
