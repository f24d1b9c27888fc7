"""Checks the project's language: the field's own words, sentences of at most 25 words, pages of at most 250 lines.

python tools/vocabulary.py            the check: lists the uses in the changed files of a folder that exceeds its ceiling
python tools/vocabulary.py FILE ...   lists every use and every long sentence of these files
python tools/vocabulary.py --counts   prints today's counts, by folder, by word, and the share of long sentences by page
python tools/vocabulary.py --lower    lowers the ceilings to today's counts

Searched: pages, comments, docstrings, messages, and identifiers (each once a file). WORDS holds what to say instead. The
ceilings in vocabulary.toml may only fall: more uses than the ceiling fail the check. A package that moves takes its uses along;
then their ceiling is moved by hand.
"""

from __future__ import annotations

import argparse
import ast
import io
import os
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parent.parent
CEILINGS = Path(__file__).with_suffix(".toml")
MAX_WORDS = 25  # of a sentence
MAX_LINES = 250  # of a page
SLACK = 5  # uses below a ceiling from which the check asks to lower it

TRACER = (
    r"s2r_runtime/(?:trace|effects)/|docs/(?:tracing|effects|first-trace)|docs/decisions/00(?:09|10|2[3-9]|3[0-8])"
    r"|tests/test_(?:trace|effects)|tools/(?:bench_trace|trace_)"
)
TRACE = r"s2r_runtime/trace/"


@dataclass(frozen=True, slots=True)
class Word:
    """One entry of the glossary. Patterns ignore case unless they say otherwise; a space matches any white space."""

    prose: str  # regular expression; whole words
    say: str
    names: str = ""  # the same within an identifier, its words separated by spaces; empty: identifiers are not searched
    where: str = ""  # regular expression of paths in which the word has the meaning of the glossary; empty: everywhere


# A longer phrase stands before the words that it contains: each place in a text counts once. A word that has an ordinary meaning as
# well is looked for only in the phrases, or in the folders, in which it means what the glossary means.
WORDS = (
    Word(r"(?:asked|judged|fitted|tested) again|(?:told|asked) anew|anew", "re-evaluated, re-linearised, again", r"asked again|anew"),
    Word(r"foretells? what was held out", "held-out log likelihood"),
    Word(r"foret(?:ell(?:s|ing)?|old)", "predict, predicted", r"foret(?:ell(?:s|ing)?|old)"),
    Word(r"told|tell(?:s|ing)?", "estimated, reported, indicates, commanded", r"told|tell(?:s|ing)?"),
    Word(r"ask(?:s|ed|ing)?", "commanded (a robot); tested, evaluated (data, a model); requested", r"asks|asked|asking"),
    Word(r"without a name|nameless", "unnamed, nonparametric", r"nameless|without a name"),
    Word(
        r"(?:is|are|was|were|be|been) named|named (?:effects?|ones?|model)|effects? named|(?:got|lent) (?:a |its |the |no )?name"
        r"|(?:a|no|its|the) names? (?:explains?|may|foretells?|says?|takes?|is|are|but|again|that)",
        "identified (effect), effect",
        where=TRACER,
    ),
    Word(r"leaves? nothing|left nothing|nothing (?:is |was )?left(?: over)?", "no significant lack of fit"),
    Word(
        r"what (?:is|was|it|they|each|these|a model|the model) left(?: over)?|left(?: |-)overs?|(?:is|are|was|were) still there",
        "residual, lack of fit",
        r"left over|leftovers?|still there",
    ),
    Word(r"beside", "given, conditional on, in addition to (of a place: next to)", r"beside"),
    Word(r"wander(?:s|ed|ing)?", "autocorrelated, drifts (random walk)", r"wander(?:s|ed|ing)?"),
    Word(r"wild|off by (?:itself|themselves)", "outlying", r"wild"),
    Word(r"sl(?:id|ides?|iding) along the recording|slid(?: along)?", "circularly shifted (surrogate data)", r"slid"),
    Word(r"nats of", "log-likelihood gain of"),
    Word(r"dictionar(?:y|ies)", "basis", r"dictionar(?:y|ies)", where=TRACER),
    Word(r"(?:a|one|no|random|what|of) fields?", "Gaussian-process disturbance", r"(?-i:Field)", where=TRACER),
    Word(r"any shape|shapes? without|(?:a|no|by|of) shapes?", "unnamed nonlinearity", r"any shape|(?-i:Shape)", where=TRACER),
    Word(r"rivals?", "competing hypothesis", r"rivals?"),
    Word(
        r"(?:tie|ties|tied) (?:with|between)|(?:that|which|what|explanations|effects|hypotheses) (?:tie|ties|tied)",
        "not distinguishable on this data",
    ),
    Word(r"ties?|tied", "not distinguishable on this data", r"ties?|tied", where=TRACER),
    Word(r"challeng(?:e[ds]?|ers?|ing)", "comparison with unnamed alternatives", r"challeng(?:e[ds]?|ers?|ing)"),
    Word(r"prices?|priced", "complexity penalty", r"prices?|priced"),
    Word(r"bars?", "acceptance threshold", r"bars?", where=TRACER),
    Word(r"first looks?", "screening", r"first looks?"),
    Word(r"(?:drawn|draws?) in (?:to|towards?|where|the more)|(?:is|are) drawn in", "shrunk (toward neutral)", r"drawn in"),
    Word(
        r"(?:its|their|whose|an? effect's|effects'|own) numbers|numbers of (?:an?|the|its|their|every|each) (?:effect|model)s?",
        "parameters",
        where=TRACER,
    ),
    Word(r"laws?", "distribution, noise model, disturbance model"),  # as an identifier mostly a control law, or a profile's key
    Word(r"rows?", "sample", where=TRACE),
    Word(
        r"way (?:that )?(?:it|they|the robot|the body) (?:goes|go|went|moved)|goes (?:somewhere|nowhere|along|far)"
        r"|(?:robot|rover|car|walker|body|wheel|sensor) (?:goes|went)",
        "displacement, moves, moved",
    ),
    Word(r"play", "backlash", r"plays?", where=TRACER),
    Word(r"for a while", "transient", r"for a while"),
    Word(r"now and then", "intermittent", r"now and then"),
    Word(
        r"lost commands?|commands? (?:that )?(?:(?:is|are|was|were|got|gets?|may be|be|been) )?lost"
        r"|los(?:es?|t|ing) (?:a |the |some )?commands?",
        "dropped",
    ),
    Word(
        r"(?:comes?|came|coming|answers?|answered|arrives?|arrived|acts?|acted) (?:too )?late|(?:m?s|seconds?) late(?: against)?"
        r"|late (?:commands?|answers?|poses?|positions?|states?|inputs?|observations?|speeds?)|(?:is|are|was|were|be) late",
        "delayed, latency",
    ),
    Word(r"late", "delayed, latency", r"late", where=TRACE),
    Word(r"(?:begins?|began|begun|beginning) under ?way|under ?way", "non-zero initial state; while moving; in progress", r"under way"),
    Word(r"(?:somebody|someone|a person)'s(?: own)? (?:model|effect|file|task)|somebody's own", "user-defined model"),
    Word(r"(?:is|are|was|were|be|been) kept(?! (?:waiting|busy|away|from|closed|open|out|apart|short))", "stored, retained"),
    Word(r"drives? under (?:a|its|the) certificate", "a certified controller"),
    Word(r"gates? (?:says?|said|refuses?|refused)", "the gate closes, the command is rejected"),
    Word(r"held against|hold(?:s|ing)? (?:[\w']+ ){0,3}against", "compared with"),
    Word(r"mend(?:s|ed|ing)?", "fixes, fixed", r"mend(?:s|ed|ing)?"),
    Word(r"(?:is|are|was|were|there's) (?-i:none)", "no ..."),
    Word(r"so many|as many", "the number, n", r"so many|as many"),
    Word(r"beyond chance", "significant (at level ...)", r"beyond chance"),
    Word(
        r"(?:an?|the|this|each|every|one|another|whole|same|live|new|fresh) drive(?! (?:motor|train|shaft|axle|wheel))"
        r"|(?:the|these|such|two|several|other|of) drives(?! (?:it|the|an?|on)\b)",
        "the excitation, the recording, the run",
    ),
    Word(r"st(?:ands?|ood) in(?! (?:for|front)\b)", "is in"),
)

# (pattern, reason): these uses are right.
ALLOWED = (
    (r"wild (?:cluster )?bootstrap", "the method's name"),
    (r"Storn and Price|Price,? 1997|(?-i:K\. Price)", "an author"),
    (r"(?:control|friction|power|motion|traction|Hooke's|Newton's|Coulomb's|Ohm's) laws?", "the physical law"),
    (r"laws? of (?:large numbers|motion|physics|cosines)", "the physical or mathematical law"),
    (r"(?:tied|ties in) ranks?|rank ties?|ties (?:are )?broken", "rank statistics"),
    (r"as many as", "a comparison of two numbers"),
    (r"bar (?:chart|plot|graph)s?|error bars?", "a figure"),
    (r"play ?back", "replay of a recording"),
    (r"order of (?:its|their) numbers", "ordinal numbers, not parameters"),
)

# Not searched: both hold the glossary itself.
SKIPPED = ("tools/vocabulary.py", "tests/test_vocabulary.py")

_SENTENCE_END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_\[]*[A-Z0-9ε#])")
_ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|cf|vs|Eq|Fig|No|Dr|[A-Z])\.(?=\s)")


@dataclass(frozen=True, slots=True)
class Use:
    """One use of a word that the glossary replaces."""

    path: str
    line: int
    text: str
    say: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.text} -> {self.say}"


def _compiled(patterns: list[str]) -> re.Pattern[str]:
    joined = "|".join(f"(?P<w{number}>{pattern})" if pattern else r"(?!)" for number, pattern in enumerate(patterns))
    return re.compile(rf"(?<![\w-])(?:{joined})(?![\w-])".replace(" ", r"[\s_]+"), re.IGNORECASE)


_ALLOWED = re.compile(rf"(?<!\w)(?:{'|'.join(pattern for pattern, _ in ALLOWED)})(?!\w)".replace(" ", r"\s+"), re.IGNORECASE)
_SEARCHES: dict[tuple[bool, ...], tuple[tuple[Word, ...], re.Pattern[str], re.Pattern[str]]] = {}


def _search(path: str) -> tuple[tuple[Word, ...], re.Pattern[str], re.Pattern[str]]:
    """The words that are searched in this file, their pattern in prose, and their pattern in identifiers."""
    applies = tuple(not word.where or re.match(word.where, path) is not None for word in WORDS)
    if applies not in _SEARCHES:
        words = tuple(word for word, does in zip(WORDS, applies, strict=True) if does)
        _SEARCHES[applies] = (words, _compiled([w.prose for w in words]), _compiled([w.names for w in words]))
    return _SEARCHES[applies]


def _in_prose(path: str, text: str, first_line: int = 1) -> Iterator[Use]:
    words, prose, _ = _search(path)
    text = _ALLOWED.sub(lambda match: re.sub(r"\S", "#", match[0]), text)
    for match in prose.finditer(text):
        word = words[int(str(match.lastgroup)[1:])]
        yield Use(path, first_line + text.count("\n", 0, match.start()), " ".join(match[0].split()), word.say)


def _in_name(path: str, name: str, line: int) -> Iterator[Use]:
    words, _, names = _search(path)
    split = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|[_.-]+", " ", name)
    for match in names.finditer(_ALLOWED.sub("", split)):
        yield Use(path, line, name, words[int(str(match.lastgroup)[1:])].say)


def uses_in_page(path: str, text: str) -> list[Use]:
    """Uses in a Markdown page. Code, and what a link leads to, are not searched."""
    return list(_in_prose(path, _prose_of_page(text)))


def uses_in_code(path: str, text: str) -> list[Use]:
    """Uses in a Python file: its name, comments, docstrings, messages, and each identifier once."""
    uses: list[Use] = []
    names: dict[str, int] = {PurePosixPath(path).stem: 1}
    comments: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            names.setdefault(token.string, token.start[0])
        elif token.type == tokenize.COMMENT:
            comment = token.string.lstrip("#: ")
            if comments and comments[-1][0] + comments[-1][1].count("\n") == token.start[0] - 1:
                comment = f"{comments[-1][1]}\n{comment}"
                comments[-1] = (comments[-1][0], comment)
            else:
                comments.append((token.start[0], comment))
    for line, comment in comments:
        uses += _in_prose(path, comment, line)
    for line, string in _strings(ast.parse(text)):
        if re.fullmatch(r"[\w.-]+", string):  # a key, a tag
            names.setdefault(string, line)
        else:
            uses += _in_prose(path, string, line)
    for name, line in names.items():
        uses += _in_name(path, name, line)
    return sorted(uses, key=lambda use: use.line)


def _strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, text) of each string; what an f-string fills in is one `…`."""
    parts: set[int] = set()
    for node in ast.walk(tree):  # breadth first: an f-string comes before its parts
        if isinstance(node, ast.JoinedStr):
            parts.update(id(value) for value in node.values)
            yield node.lineno, "".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.lineno, node.value


def _prose_of_page(text: str) -> str:
    """The page's text with code and the targets of links blanked; lines stay where they are."""
    blank = lambda match: re.sub(r"[^\n]", " ", match[0])  # noqa: E731
    text = re.sub(r"^ *```.*?^ *```", blank, text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"`[^`\n]+`", lambda match: re.sub(r"\S", "#", match[0].replace(" ", "#")), text)
    return re.sub(r"(?<=\])\([^)\n]*\)", blank, text)


def sentences(text: str) -> list[str]:
    """The sentences of a Markdown page: of paragraphs, list items, headings, and cells of tables; no lists of names in code."""
    blocks: list[str] = []
    for line in _prose_of_page(text).splitlines():
        stripped = line.strip(" >")
        if stripped.startswith("|"):
            blocks += ["", *re.split(r"(?<!\\)\|", stripped), ""]
        elif not stripped or re.match(r"#+ |[-*+] |\d+\. |<", stripped):
            blocks += ["", re.sub(r"^(?:#+|[-*+]|\d+\.) ", "", stripped)]
        elif blocks:
            blocks[-1] += " " + stripped
        else:
            blocks.append(stripped)
    found: list[str] = []
    for block in blocks:
        marked = _ABBREVIATION.sub(lambda match: match[0].replace(".", "․"), block)
        found += [" ".join(one.replace("․", ".").split()) for one in _SENTENCE_END.split(marked)]
    return [one for one in found if words_of(one) > 1 and not _lists_code(one)]


def _lists_code(sentence: str) -> bool:
    """Whether half of the words or more are inline code: a list of names rather than a sentence."""
    return 2 * len(re.findall(r"#{3,}", sentence)) >= words_of(sentence)


def words_of(sentence: str) -> int:
    """Number of words: what holds a letter or a digit. An inline code or formula without spaces is one."""
    return sum(1 for part in sentence.split() if re.search(r"[^\W_]|#", part))


def folder_of(path: str) -> str:
    """The folder whose ceiling a file counts for: a package of s2r_runtime, a plug-in, or the top folder."""
    parts = PurePosixPath(path).parts
    if len(parts) == 1:
        return "."
    return "/".join(parts[:2]) if parts[0] in ("s2r_runtime", "plugins") and len(parts) > 2 else parts[0]


def _files() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "*.py", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return [path for path in listed if path not in SKIPPED and (ROOT / path).is_file()]


def _uses(path: str) -> list[Use]:
    text = (ROOT / path).read_text(encoding="utf-8")
    return uses_in_page(path, text) if path.endswith(".md") else uses_in_code(path, text)


def _is_page(path: str) -> bool:
    return path == "README.md" or re.fullmatch(r"docs/[^/]+\.md", path) is not None


def trouble(what: str, counts: dict[str, int], ceilings: dict[str, int]) -> tuple[list[str], list[str]]:
    """(counts above their ceilings, ceilings that can be lowered), one line each. What has no ceiling has ceiling 0."""
    above = [f"{what} of {one}: {n}, ceiling {ceilings.get(one, 0)}" for one, n in sorted(counts.items()) if n > ceilings.get(one, 0)]
    falls = {one: (ceiling, counts.get(one, 0)) for one, ceiling in sorted(ceilings.items())}
    low = [f"{what} of {one}: {n}, ceiling {ceiling}" for one, (ceiling, n) in falls.items() if ceiling - n > SLACK or ceiling > n == 0]
    return above, low


def _toml(ceilings: dict[str, dict[str, int]]) -> str:
    lines = ["# Ceilings of tools/vocabulary.py. They may only fall: tools/vocabulary.py --lower writes what today's counts allow."]
    for table, values in ceilings.items():
        lines += ["", f"[{table}]", *(f'"{one}" = {n}' for one, n in sorted(values.items()) if n)]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Returns 0 if nothing is above its ceiling, else 1."""
    parsing = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parsing.add_argument("file", nargs="*", help="list the uses and the long sentences of these files")
    parsing.add_argument("--counts", action="store_true", help="print the counts")
    parsing.add_argument("--lower", action="store_true", help="lower the ceilings to the counts")
    options = parsing.parse_args()
    if options.file:
        return _show([os.path.relpath(one, ROOT) for one in options.file])
    files = _files()
    uses = {path: _uses(path) for path in files}
    pages = {path: (ROOT / path).read_text(encoding="utf-8") for path in files if _is_page(path)}
    long = {path: [one for one in sentences(text) if words_of(one) > MAX_WORDS] for path, text in pages.items()}
    words: Counter[str] = Counter()
    for path, found in uses.items():
        words[folder_of(path)] += len(found)
    counts: dict[str, dict[str, int]] = {
        "words": dict(words),
        "long_sentences": {path: len(found) for path, found in long.items()},
        "long_pages": {path: lines for path, text in pages.items() if (lines := text.count("\n")) > MAX_LINES},
    }
    number = {path: len(sentences(text)) for path, text in pages.items()}
    if options.counts:
        _print_counts(counts, number, Counter(use.say for found in uses.values() for use in found))
    share = sum(map(len, long.values())) / max(sum(number.values()), 1)
    print(f"{words.total()} words of the glossary; {share:.1%} of {sum(number.values())} sentences in docs have over {MAX_WORDS} words")
    ceilings = tomllib.loads(CEILINGS.read_text(encoding="utf-8")) if CEILINGS.exists() else counts
    if options.lower:
        CEILINGS.write_text(_toml({table: lowered(values, ceilings.get(table, {})) for table, values in counts.items()}), encoding="utf-8")
        return 0
    troubles = {table: trouble(table.replace("_", " "), values, ceilings.get(table, {})) for table, values in counts.items()}
    above = [line for more, _ in troubles.values() for line in more]
    low = [line for _, less in troubles.values() for line in less]
    exceeded = {folder for folder, n in counts["words"].items() if n > ceilings["words"].get(folder, 0)}
    listed = [path for path in files if folder_of(path) in exceeded]
    for path in _changed(listed) or listed:
        print(*uses[path], sep="\n", end="\n" if uses[path] else "")
    for path, too_long in long.items():
        if len(too_long) > ceilings["long_sentences"].get(path, 0):
            print(*(f"{path}: {words_of(one)} words: {one}" for one in too_long), sep="\n")
    if low:
        print("lower these ceilings (tools/vocabulary.py --lower):", *low, sep="\n  ")
    if above:
        print("above the ceiling:", *above, sep="\n  ", file=sys.stderr)
    return 1 if above else 0


def lowered(counts: dict[str, int], ceilings: dict[str, int]) -> dict[str, int]:
    """The ceilings that these counts allow: none higher than it was, and none for what had none."""
    return {one: min(counts.get(one, 0), ceiling) for one, ceiling in ceilings.items()}


def _changed(paths: list[str]) -> list[str]:
    """Those of the files that the last commit or the working tree changed."""
    done = subprocess.run(["git", "diff", "--name-only", "HEAD~1"], cwd=ROOT, capture_output=True, text=True, check=False)
    return sorted(set(done.stdout.split()) & set(paths))


def _print_counts(counts: dict[str, dict[str, int]], number: dict[str, int], by_word: Counter[str]) -> None:
    for title, table in (("folder", counts["words"]), ("say instead", by_word)):
        print(title, *(f"{n:6d}  {one}" for one, n in sorted(table.items(), key=lambda item: -item[1])), sep="\n", end="\n\n")
    print(f"sentences of over {MAX_WORDS} words")
    for path, n in counts["long_sentences"].items():
        print(f"{n:6d} of {number[path]:4d}  {n / max(number[path], 1):4.0%}  {path}")
    print()


def _show(paths: list[str]) -> int:
    """Lists the uses and the long sentences of these files; 1 if there are any."""
    found: list[str] = []
    for path in paths:
        found += map(str, _uses(path))
        if path.endswith(".md"):
            all_of_it = sentences((ROOT / path).read_text(encoding="utf-8"))
            long = [one for one in all_of_it if words_of(one) > MAX_WORDS]
            found += [f"{path}: {words_of(one)} words: {one}" for one in long]
            found.append(f"{path}: {len(long)} of {len(all_of_it)} sentences are longer than {MAX_WORDS} words")
    print(*found, sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
