"""Lives of the core that were recorded are answered as they were then, event by event: what an audit of an old log rests on."""

from __future__ import annotations

import pytest
from core_lives import recorded, replayed


@pytest.mark.slow
def test_recorded_lives_are_answered_as_they_were() -> None:
    lives = recorded()
    assert len(lives) > 200
    assert sum(len(life.events) for life in lives) > 10_000
    for life in lives:
        made = replayed(life.events)
        first = next((index for index, (now, then) in enumerate(zip(made, life.made, strict=True)) if now != then), None)
        assert first is None, (
            f"{life.name}: event {first}, {life.events[first or 0]}, is answered otherwise; if that is meant: python tests/core_lives.py"
        )
