"""The messages are one import, each says what it is, and none is forgotten in the unions that decide what a log can hold."""

from __future__ import annotations

from types import ModuleType
from typing import get_args

import pytest

from s2r_runtime import messages
from s2r_runtime.messages import events, link, memory, outputs, results
from s2r_runtime.recording.channels import CHANNELS, schema


def structs(module: ModuleType) -> list[type[messages.Struct]]:
    """What is defined in that module, not what it imports."""
    return [
        kind
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, messages.Struct) and kind.__module__ == module.__name__
    ]


@pytest.mark.parametrize("module", [events, link, memory, outputs, results], ids=lambda module: module.__name__.rpartition(".")[2])
def test_every_message_is_imported_from_one_place(module: ModuleType) -> None:
    assert [kind.__name__ for kind in structs(module) if getattr(messages, kind.__name__, None) is not kind] == []


def test_every_event_and_every_output_has_a_channel() -> None:
    assert set(structs(events)) == set(get_args(messages.Event))
    assert set(structs(outputs)) == set(get_args(messages.Output))


@pytest.mark.parametrize("name", CHANNELS)
def test_a_channel_says_what_its_messages_mean(name: str) -> None:
    """What stands in the log's schema is the message's own docstring, not that of its base."""
    said = schema(CHANNELS[name])["description"]
    assert said
    assert said != schema(messages.Struct)["description"]
