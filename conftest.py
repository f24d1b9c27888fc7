"""Tests that wait for robots for minutes begin first, so that the others run beside them; files stay together (see the Makefile)."""

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
