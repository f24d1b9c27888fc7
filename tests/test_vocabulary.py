"""The language check finds the words that the glossary replaces, in the meanings that it replaces, and long sentences."""

from __future__ import annotations

import re

import pytest
import vocabulary


def _found(text: str, path: str = "s2r_runtime/trace/some.py") -> list[tuple[int, str]]:
    find = vocabulary.uses_in_page if path.endswith(".md") else vocabulary.uses_in_code
    return [(use.line, use.text) for use in find(path, text)]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('"""What the robot was told."""\n', [(1, "told")]),
        ('"""First line.\n\nThe speed wanders,\nbeyond\nchance.\n"""\n', [(3, "wanders"), (4, "beyond chance")]),
        ("x = 1\n# a long comment that\n# tells it\n", [(3, "tells")]),
        ("def was_told(x, y):\n    return was_told(x, y)\n", [(1, "was_told")]),
        ("class ForetoldSpeed: ...\n", [(1, "ForetoldSpeed")]),
        ('x = {"asked_again": 1}\n', [(1, "asked_again")]),
        ('raise ValueError(f"{x} ties with {y}")\n', [(1, "ties with")]),
        ('"""Asked again."""\n', [(1, "Asked again")]),
    ],
)
def test_each_kind_of_text_is_searched(text: str, found: list[tuple[int, str]]) -> None:
    assert _found(text) == found


@pytest.mark.parametrize(
    "text",
    [
        "# besides the stand-in, which replays a wildcard\n",
        "# the friction law; ranks with ties broken at random\n",
        "if x is None or y == 'none': ...\n",
        "# Storn and Price 1997\n",
        "# a wild bootstrap\n",
        "from dataclasses import field\n",
        "shape = x.shape\n",
    ],
)
def test_the_right_uses_of_a_word_are_left_alone(text: str) -> None:
    assert _found(text) == []


@pytest.mark.parametrize(
    ("text", "where", "elsewhere"),
    [
        ("# every row\n", 1, 0),
        ("# the dictionary of d\n", 1, 0),
        ("# a field of it\n", 1, 0),
        ("# a name is lent\n", 1, 0),
        ("# is it told\n", 1, 1),
    ],
)
def test_ordinary_words_count_where_they_have_the_meaning_of_the_glossary(text: str, where: int, elsewhere: int) -> None:
    assert len(_found(text, "s2r_runtime/trace/some.py")) == where
    assert len(_found(text, "s2r_runtime/table.py")) == elsewhere


def test_code_and_the_targets_of_links_in_pages_are_not_searched() -> None:
    page = "It was `told` [here](told.md).\n\n```console\n$ told\n```\n\nIt was told.\n"
    assert _found(page, "docs/some.md") == [(7, "told")]


def test_every_word_of_the_table_says_what_to_say_instead() -> None:
    for word in vocabulary.WORDS:
        assert word.say
        assert re.compile(word.prose)
        assert re.compile(word.where)
        assert vocabulary.uses_in_page("docs/some.md", word.say) == [] or "Gaussian" in word.say, word.say


def test_sentences_are_those_of_paragraphs_items_and_cells() -> None:
    text = "# A title\n\nOne sentence, e.g. this\none. `Two. Three.` stays one.\n\n- an item\n- another one\n"
    page = f"{text}\n| a cell | b c |\n| --- | --- |\n"
    assert vocabulary.sentences(page) == [
        "A title",
        "One sentence, e.g. this one.",
        "############# stays one.",
        "an item",
        "another one",
        "a cell",
        "b c",
    ]


def test_a_list_of_names_in_code_is_no_sentence() -> None:
    assert vocabulary.sentences("`one`, `two` (a number), `three`.") == []
    assert len(vocabulary.sentences("The key `one` holds a number.")) == 1


def test_words_are_what_holds_letters_or_digits() -> None:
    assert vocabulary.words_of("at 0.5 s - `of` it: (one) = #### …") == 7


def test_a_count_above_its_ceiling_is_trouble_and_one_far_below_is_said() -> None:
    above, low = vocabulary.trouble("words", {"a": 3, "b": 1, "c": 20, "d": 9}, {"a": 2, "c": 30, "d": 10})
    assert above == ["words of a: 3, ceiling 2", "words of b: 1, ceiling 0"]
    assert low == ["words of c: 20, ceiling 30"]


def test_a_ceiling_never_rises() -> None:
    assert vocabulary.lowered({"a": 3, "b": 1, "new": 4}, {"a": 2, "b": 5, "gone": 1}) == {"a": 2, "b": 1, "gone": 0}


@pytest.mark.parametrize(
    ("path", "folder"),
    [
        ("README.md", "."),
        ("docs/decisions/0001.md", "docs"),
        ("s2r_runtime/gate.py", "s2r_runtime"),
        ("s2r_runtime/trace/a/b.py", "s2r_runtime/trace"),
        ("plugins/can/s2r_can/dbc.py", "plugins/can"),
    ],
)
def test_each_package_has_its_ceiling(path: str, folder: str) -> None:
    assert vocabulary.folder_of(path) == folder
