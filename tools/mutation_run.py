"""Runs mutants: which tests execute their lines, one forked process for each, the tests one after the other until one fails.

One process imports nothing of the project and forks. A first child collects the tests, runs each once and notes its lines, then forks for
each mutant of a function: the grandchild gives the function the mutant's code and runs the tests (`Session`). A mutant of a constant is
tried by running its statement again; that, and a default, takes full effect only when its module is imported, so what survives has a child
that imports everything anew (`constants`).
"""

from __future__ import annotations

import ast
import importlib
import importlib.machinery
import os
import pickle
import resource
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

from mutants import Mutant

ROOT = Path(__file__).parent.parent
QUICK_S = 20.0
"""Tests that take longer than this while their lines are noted are left out: what only they would notice counts as not noticed."""
LONG = ROOT / "tests" / "test_core_walk.py", ROOT / "tests" / "test_fault_injection.py"
"""Files of which only single tests are run; a mutant that takes effect at import runs whole files."""
CPU_S = 3
"""Of a mutant's tests together, beyond four times what they need without it; one that needs more hangs, and that is noticed."""
WHOLE_S = 15.0
"""What all tests together need, imports included."""
PRELOAD = (
    "pytest",
    "hypothesis",
    "msgspec",
    "numpy",
    "cryptography.hazmat.primitives.asymmetric.ed25519",
    "scipy.special",
    "mcap.reader",
    "pluggy",
)
"""What the tests need besides the project: imported once, before anything forks."""

SURVIVED, KILLED, BROKEN, UNREACHED = "survived", "killed", "broken", "unreached"


@dataclass
class Plan:
    """What is to be run."""

    files: dict[str, Path]
    trees: dict[str, ast.Module]
    mutants: list[Mutant]
    folder: Path
    jobs: int
    coverage_only: bool
    told: Path | None = None
    """Where what came of each mutant is noted as soon as it is known."""
    results: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Mutant's name -> what came of it, and the first test that failed or the last file that did not."""

    def ended(self, one: Mutant, result: tuple[str, str]) -> None:
        """Notes what came of a mutant."""
        self.results[one.name] = result
        if self.told is not None:
            with self.told.open("a", encoding="utf-8") as lines:
                lines.write(f"{result[0]}\t{one.name}\t{result[1]}\n")


# ---------------------------------------------------------------- tests with their lines


class Lines:
    """Executed lines of the chosen files: switch on, run, ask."""

    def __init__(self, files: dict[str, Path]) -> None:
        self.names = {str(path): name for name, path in files.items()}
        self.seen: set[tuple[str, int]] = set()

    def __enter__(self) -> Lines:
        self.seen = set()
        sys.settrace(self._call)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _call(self, frame: Any, event: str, _: object) -> Any:
        name = self.names.get(frame.f_code.co_filename)
        return None if name is None else self._line

    def _line(self, frame: Any, event: str, _: object) -> Any:
        if event == "line":
            self.seen.add((self.names[frame.f_code.co_filename], frame.f_lineno))
        return self._line


def executable(name: str, tree: ast.Module, path: Path) -> set[tuple[str, int]]:
    """Lines inside of functions; those of the module itself run when it is imported."""
    found: set[tuple[str, int]] = set()

    def inside(code: CodeType) -> None:
        for one in code.co_consts:
            if isinstance(one, CodeType):
                if one.co_name == "<lambda>" or (not one.co_name.startswith("<") and one.co_flags & 2):  # a function, no class body
                    found.update((name, line) for *_, line in one.co_lines() if line and line != one.co_firstlineno)
                inside(one)

    inside(compile(tree, str(path), "exec"))
    return found


def run_tests(items: list[Any], report: Callable[[Any, bool, float], None] | None = None) -> str:
    """The first test that fails, or empty."""
    from _pytest.runner import runtestprotocol

    for index, item in enumerate(items):
        following = items[index + 1] if index + 1 < len(items) else None
        begun = time.process_time()
        failed = any(one.failed for one in runtestprotocol(item, log=False, nextitem=following))
        if report is not None:
            report(item, failed, time.process_time() - begun)
        elif failed:
            return str(item.nodeid)
    return ""


class Session:
    """A pytest plug-in that does all this in the place of pytest's own loop."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.covering: dict[tuple[str, int], set[int]] = defaultdict(set)
        self.cost: list[float] = []

    def pytest_runtestloop(self, session: Any) -> bool:
        """In place of pytest's own: all tests once as they are, then those that run a function against every change of it."""
        items = list(session.items)
        self.baseline(items)
        covered = set(self.covering)
        notes = {"covered": covered, "files": self._files(items), "failed": []}
        Path(self.plan.folder / "baseline").write_bytes(pickle.dumps(notes))
        if not self.plan.coverage_only:
            self.functions(items)
        return True

    def baseline(self, items: list[Any]) -> None:
        """Every test by itself, without a change: what it costs (s of the processor) and which lines it runs. Exits with 3 if one fails."""
        watch = Lines(self.plan.files)
        for index, item in enumerate(items):
            with watch:
                begun = time.process_time()
                failed = run_tests([item])
                self.cost.append(time.process_time() - begun)
            if failed:
                print(f"{failed} fails without any change; mend it first", file=sys.stderr, flush=True)
                os._exit(3)
            for place in watch.seen:
                self.covering[place].add(index)

    def _files(self, items: list[Any]) -> dict[str, list[str]]:
        """Module -> test files that run something of it, the one with the most lines first."""
        counts: dict[str, Counter[str]] = defaultdict(Counter)
        for (name, _), tests in self.covering.items():
            for path in {str(items[index].path) for index in tests if self.cost[index] < QUICK_S} - {str(one) for one in LONG}:
                counts[name][path] += 1
        return {name: [path for path, _ in count.most_common()] for name, count in counts.items()}

    def functions(self, items: list[Any]) -> None:
        """Runs the mutants of functions."""
        objects = {(name, where): found for name in self.plan.files for where, found in named_functions(name).items()}
        killers: dict[str, Counter[int]] = defaultdict(Counter)
        by_id = {item.nodeid: index for index, item in enumerate(items)}
        work = [one for one in self.plan.mutants if one.where or not isinstance(one.top, ast.ClassDef)]
        whole: dict[str, set[int]] = defaultdict(set)
        for (name, _), tests in self.covering.items():
            whole[name] |= tests

        def order(one: Mutant) -> list[int]:
            found: set[int] = set() if one.where else set(whole[one.module])
            for line in range(one.lines[0], one.lines[1] + 1):
                found |= self.covering.get((one.module, line), set())
            quick = [index for index in found if self.cost[index] < QUICK_S]
            liked = killers[one.module + one.where]
            return sorted(quick, key=lambda index: (-liked[index], self.cost[index]))

        def start(one: Mutant) -> tuple[Callable[[], tuple[str, str]], float] | None:
            chosen = order(one)
            if not chosen:
                self.plan.ended(one, (UNREACHED, ""))
                return None

            def child() -> tuple[str, str]:
                path = str(self.plan.files[one.module])
                if one.where:
                    objects[one.module, one.where].__code__ = one.code(path)
                else:  # whoever imported the name before still has the original: what survives this is tried again (`constants`)
                    exec(one.statement_code(path), vars(imported(one.module)))  # noqa: S102 - our own source
                failed = run_tests([items[index] for index in chosen])
                return (KILLED, failed) if failed else (SURVIVED, "")

            return child, sum(self.cost[index] for index in chosen)

        def ended(one: Mutant, result: tuple[str, str]) -> None:
            self.plan.ended(one, result)
            if result[1] in by_id:
                killers[one.module + one.where][by_id[result[1]]] += 1

        forked(work, start, ended, self.plan)
        Path(self.plan.folder / "functions").write_bytes(pickle.dumps(self.plan.results))


def imported(name: str) -> Any:
    """The module of this short name."""
    return importlib.import_module("s2r_runtime." + name.removesuffix(".py").replace("/", ".").removesuffix(".__init__"))


def named_functions(name: str) -> dict[str, FunctionType]:
    """Qualified name -> function, of one module."""
    module = imported(name)
    found: dict[str, FunctionType] = {}

    def look(value: Any) -> None:
        one = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
        if isinstance(one, FunctionType) and one.__module__ == module.__name__:
            found[one.__qualname__] = one

    for value in vars(module).values():
        look(value)
        if isinstance(value, type) and value.__module__ == module.__name__:
            for inner in vars(value).values():
                look(inner)
    return found


# ---------------------------------------------------------------- processes


def forked(
    work: list[Mutant],
    start: Callable[[Mutant], tuple[Callable[[], tuple[str, str]], float] | None],
    ended: Callable[[Mutant, tuple[str, str]], None],
    plan: Plan,
) -> None:
    """Each in a process of its own, so many at a time."""
    running: dict[int, tuple[Mutant, int]] = {}
    waiting: Iterator[Mutant] = iter(work)
    done = 0
    while True:
        one = next(waiting, None) if len(running) < plan.jobs else None
        if one is not None:
            child = start(one)
            if child is not None:
                reader, writer = os.pipe()
                pid = os.fork()
                if pid == 0:
                    os.close(reader)
                    in_child(*child, writer)
                os.close(writer)
                running[pid] = one, reader
            else:
                done += 1
            if len(running) < plan.jobs:
                continue
        if not running:
            return
        pid, status = os.wait()
        mutant, reader = running.pop(pid)
        with os.fdopen(reader, "rb") as pipe:
            said = pipe.read()
        result = pickle.loads(said) if said else (KILLED, f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else "it exited")  # noqa: S301 - our own child
        ended(mutant, result)
        done += 1
        if sys.stderr.isatty() or done % 250 == 0:
            print(f"{done} of {len(work)}", file=sys.stderr, flush=True)


def in_child(child: Callable[[], tuple[str, str]], cost_s: float, writer: int) -> None:
    """Runs it within limits and says what came of it. cost_s: of its tests without a change. Never returns."""
    try:
        sink = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(sink, number)
        most = round(CPU_S + 4.0 * cost_s)
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))  # a loop that only collects ends in time
        signal.alarm(20 * most)
        try:
            result = child()
        except SyntaxError as error:
            result = (BROKEN, repr(error))
        except BaseException as error:  # noqa: BLE001 - whatever the mutant raises where no test catches it
            result = (KILLED, repr(error))
        os.write(writer, pickle.dumps(result))
    finally:
        os._exit(0)


def run_pytest(plugins: list[Any], paths: list[str], plan: Plan, *options: str) -> int:
    """Without what would write into the project, start other processes or take its time over a failure."""
    import pytest
    from hypothesis import Phase, settings

    settings.register_profile("mutation", derandomize=True, database=None, phases=(Phase.explicit, Phase.generate))
    settings.load_profile("mutation")
    scratch = tempfile.mkdtemp(dir=plan.folder)
    argv = ["-p", "no:cacheprovider", "-p", "no:xdist", "-s", f"--basetemp={scratch}/t", "--rootdir", str(ROOT)]
    argv += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # hypothesis was imported before, on purpose
    return int(pytest.main([*argv, *options, *paths], plugins=plugins))


def constants(plan: Plan, files: dict[str, list[str]]) -> None:
    """Runs the mutants that take effect at import."""

    def start(one: Mutant) -> tuple[Callable[[], tuple[str, str]], float] | None:
        paths = files.get(one.module, [])
        if not paths:
            plan.ended(one, (UNREACHED, ""))
            return None

        def child() -> tuple[str, str]:
            changed(one, plan)
            for path in paths:
                code = run_pytest([], [path], plan, "-x", "-m", "not slow")
                if code not in (0, 5):
                    return KILLED, Path(path).name
            return SURVIVED, Path(paths[-1]).name

        return child, WHOLE_S

    work = [one for one in plan.mutants if not one.where and plan.results.get(one.name, ("", ""))[0] != KILLED]
    forked(work, start, plan.ended, plan)


def changed(one: Mutant, plan: Plan) -> None:
    """From now on, importing this module gives the mutant."""
    path, loader = str(plan.files[one.module]), importlib.machinery.SourceFileLoader
    code, original = one.module_code(plan.trees[one.module], path), loader.get_code

    def get_code(self: Any, fullname: str) -> Any:
        return code if self.get_filename(fullname) == path else original(self, fullname)

    loader.get_code = get_code  # type: ignore[method-assign,assignment]
