"""Promises of the built-in tasks: their laws, their metrics against slow and simple reference code, and what they refuse."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import pytest

from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_lower, clopper_pearson_upper
from s2r_runtime.hookspecs import Scenario, Task
from s2r_runtime.models.joint import MODEL as JOINT
from s2r_runtime.models.unicycle import MODEL as UNICYCLE
from s2r_runtime.tasks.grid_world import GridWorld
from s2r_runtime.tasks.keep_out import KeepOut

DT = 0.033
SURE = 1e-4
"""Chance that a single exact interval is missed by luck; the seeds are fixed, so it was either had or not."""
QUADRUPED = {"columns": 5, "rows": 5, "cell": 1.0, "static": 5, "goals": 1, "movers": 0, "robot_radius": 0.3, "min_progress": 1.0}


def grid(**parameters: float) -> GridWorld:
    return GridWorld(parameters, UNICYCLE, DT)


def assert_share(hits: int, n: int, share: float) -> None:
    """hits of n is compatible with this probability."""
    assert clopper_pearson_lower(hits, n, SURE) <= share <= clopper_pearson_upper(hits, n, SURE)


def path_lengths(blocked: np.ndarray, goals: list[tuple[int, int]], cell: float) -> dict[tuple[int, int], float]:
    """Breadth-first search over one scenario's cells (row, column), the slow way."""
    found = dict.fromkeys(goals, 0.0)
    queue = deque(goals)
    while queue:
        row, column = queue.popleft()
        for beside in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if not blocked[beside] and beside not in found:
                found[beside] = found[row, column] + cell
                queue.append(beside)
    return found


def cell_of(task: GridWorld, x: float, y: float) -> tuple[int, int]:
    g = task.grid
    return math.floor((y - g.bottom) / g.cell) + 1, math.floor((x - g.left) / g.cell) + 1


def wall_distance(task: GridWorld, blocked: np.ndarray, x: float, y: float) -> float:
    """Distance to the nearest blocked cell, or to the wall, by looking at all of them; 0 inside one."""
    g = task.grid
    right, top = g.left + g.columns * g.cell, g.bottom + g.rows * g.cell
    least = min(x - g.left, right - x, y - g.bottom, top - y)
    for row in range(1, g.rows + 1):
        for column in range(1, g.columns + 1):
            if blocked[row, column]:
                low_x, low_y = g.left + (column - 1) * g.cell, g.bottom + (row - 1) * g.cell
                aside = max(low_x - x, 0.0, x - low_x - g.cell)
                above = max(low_y - y, 0.0, y - low_y - g.cell)
                least = min(least, math.hypot(aside, above))
    return max(least, 0.0)


# ---------------------------------------------------------------- the grid's law


@pytest.mark.parametrize("parameters", [{}, QUADRUPED])
def test_scenarios_are_as_the_paper_says(parameters: dict[str, float]) -> None:
    task = grid(**parameters)
    g = task.grid
    scenario = task.draw(np.random.default_rng(1), 300)
    theta = task.view(scenario)
    assert theta["blocked"].shape == theta["distance"].shape == (300, g.rows + 2, g.columns + 2)
    for i in range(300):
        blocked = theta["blocked"][i]
        assert blocked[1:-1, 1:-1].sum() == task.PARAMETERS["static"][0] if not parameters else parameters["static"]
        assert blocked[0].all()
        assert blocked[-1].all()
        assert blocked[:, 0].all()
        assert blocked[:, -1].all()
        start = cell_of(task, *scenario["start"][i, :2])
        goals = [cell_of(task, *goal) for goal in theta["goals"][i]]
        movers = [cell_of(task, x, y) for x, y in zip(theta["mover_x"][i], theta["mover_y"][i], strict=True)]
        assert len({start, *goals, *movers}) == 1 + len(goals) + len(movers)
        assert not any(blocked[cell] for cell in (start, *goals, *movers))
        assert all(max(abs(row - start[0]), abs(column - start[1])) >= 2 for row, column in movers)
        lengths = path_lengths(blocked, goals, g.cell)
        assert start in lengths
        for cell in np.ndindex(blocked.shape):
            assert theta["distance"][i][cell] == pytest.approx(lengths.get(cell, math.inf))
        clear = wall_distance(task, blocked, *scenario["start"][i, :2]) - (0.3 if parameters else 0.055)
        assert clear >= 0.045 - 1e-12
    assert np.all(np.abs(scenario["start"][:, 2]) <= math.pi)


def test_layouts_are_uniform_given_that_a_goal_can_be_reached() -> None:
    # three cells in a row, one obstacle, one goal: with the obstacle in the middle there is no way, the other four layouts are alike
    task = grid(columns=3, rows=1, static=1, goals=1, movers=0)
    n = 20_000
    theta = task.view(task.draw(np.random.default_rng(2), n))
    goal = np.rint((theta["goals"][:, 0, 0] - task.grid.centre_x[6]) / 0.4).astype(int)
    wall = np.argmax(theta["blocked"][:, 1, 1:-1], axis=1)
    layouts, counts = np.unique(np.stack([wall, goal]), axis=1, return_counts=True)
    assert layouts.T.tolist() == [[0, 1], [0, 2], [2, 0], [2, 1]]
    for count in counts:
        assert_share(int(count), n, 0.25)


def test_the_start_is_uniform_over_all_places_with_enough_clearance() -> None:
    task = grid(columns=4, rows=3, static=0, goals=1, movers=0)
    n = 12_000
    start = task.draw(np.random.default_rng(3), n)["start"]
    # 0.1 m from the walls: (1.6 - 0.2) m x (1.2 - 0.2) m; the goal is in each of the cells as often, and leaves the start the others
    for low in np.arange(-0.7, 0.7, 0.2):
        assert_share(int(np.sum((start[:, 0] >= low) & (start[:, 0] < low + 0.2))), n, 1.0 / 7.0)
    for low in np.arange(-0.5, 0.5, 0.25):
        assert_share(int(np.sum((start[:, 1] >= low) & (start[:, 1] < low + 0.25))), n, 0.25)
    assert_share(int(np.sum(start[:, 2] > 0.0)), n, 0.5)


def test_a_scenario_drawn_at_the_robot_is_the_law_given_that_start() -> None:
    task = grid(columns=3, rows=1, static=1, goals=1, movers=0)
    at = np.array([task.grid.centre_x[6] + 0.03, 0.02, 1.0])  # the leftmost cell: the obstacle must be the rightmost, or beside the goal
    rng = np.random.default_rng(4)
    drawn = [task.draw_at(rng, at) for _ in range(50)]
    for scenario in drawn:
        assert scenario["start"].tolist() == [at.tolist()]
        assert task.view(scenario)["blocked"][0, 1].tolist() == [True, False, False, True, True]
    at[0] = 0.0  # the middle: either side
    walls = [int(np.argmax(task.view(task.draw_at(rng, at))["blocked"][0, 1, 1:-1])) for _ in range(2000)]
    assert set(walls) == {0, 2}
    assert_share(walls.count(0), 2000, 0.5)


@pytest.mark.parametrize(
    ("place", "words"),
    [((2.0, 0.0), "x 2.000"), ((1.52, 0.0), "at least 0.045 m from the wall"), ((0.0, -0.99), "y -0.990"), ((math.nan, 0.0), "x nan")],
)
def test_no_scenario_is_drawn_where_the_law_has_none(place: tuple[float, float], words: str) -> None:
    with pytest.raises(NotEnoughEvidence, match=words):
        grid().draw_at(np.random.default_rng(5), np.array([*place, 0.0]))


def test_a_scenario_drawn_at_the_robot_leaves_it_room() -> None:
    task, rng = grid(), np.random.default_rng(6)
    for _ in range(60):
        x = np.array([rng.uniform(-1.49, 1.49), rng.uniform(-0.89, 0.89), 0.3])  # edges and corners of cells among them
        scenario = task.draw_at(rng, x)
        clear = task.clearance(x[None], scenario)
        assert clear is not None
        assert clear[0] >= 0.045


# ---------------------------------------------------------------- what moves


def test_movers_keep_to_free_cells_go_straight_back_or_turn_and_never_jump() -> None:
    task, rng = grid(), np.random.default_rng(7)
    scenario = task.draw(rng, 200)
    period = round(0.4 / (0.1 * DT))
    for step in range(1, 4 * period + 1):
        before, scenario = scenario, task.advance(scenario, rng)
        dx, dy = scenario["mover_x"] - before["mover_x"], scenario["mover_y"] - before["mover_y"]
        speed = np.hypot(dx, dy) / DT
        assert np.all((speed < 1e-9) | (np.abs(speed - 0.4 / (period * DT)) < 1e-9))
        assert np.all((np.abs(dx) < 1e-12) | (np.abs(dy) < 1e-12))
        if step % period == 0:
            rows = np.arange(200)[:, None]
            assert not np.any(scenario["blocked"][rows, scenario["mover_cell"]])
            assert np.allclose(scenario["mover_x"], task.grid.centre_x[scenario["mover_cell"]], atol=1e-12)


def test_movers_turn_as_often_as_they_should() -> None:
    task, rng = (
        grid(columns=9, rows=9, static=0, goals=1, movers=1, clear_cells=0, turn=0.3, mover_speed=0.4 / DT),
        np.random.default_rng(8),
    )
    scenario = task.draw(rng, 30_000)  # a cell a step
    after = task.advance(scenario, rng)
    inner = (np.abs(after["mover_x"][:, 0]) < 1.3) & (np.abs(after["mover_y"][:, 0]) < 1.3)  # not at the wall
    was, now = scenario["mover_direction"][inner, 0], after["mover_direction"][inner, 0]
    turned = (now - was) % 4
    assert_share(int(np.sum(turned == 1)), len(turned), 0.15)
    assert_share(int(np.sum(turned == 3)), len(turned), 0.15)
    assert not np.any(turned == 2)
    for direction in range(4):
        assert_share(int(np.sum(was == direction)), len(was), 0.25)


def test_a_mover_shut_in_stands_still() -> None:
    task, rng = grid(columns=4, rows=1, static=1, goals=1, movers=1, clear_cells=0, mover_speed=0.4 / DT), np.random.default_rng(9)
    scenario = task.draw(rng, 400)
    walls = scenario["blocked"][np.arange(400)[:, None], scenario["mover_cell"] + np.array([[1, -1]])].all(axis=1)
    assert walls.any()
    after = task.advance(scenario, rng)
    assert np.array_equal(after["mover_x"][walls], scenario["mover_x"][walls])


# ---------------------------------------------------------------- the grid's metric


def test_clearance_is_the_distance_to_the_nearest_of_everything() -> None:
    task, rng = grid(), np.random.default_rng(10)
    scenario = task.draw(rng, 2000)
    x = np.stack([rng.uniform(-1.6, 1.6, 2000), rng.uniform(-1.0, 1.0, 2000), np.zeros(2000)], axis=1)
    clear = task.clearance(x, scenario)
    blocked = task.view(scenario)["blocked"]
    for i in range(2000):
        walls = wall_distance(task, blocked[i], x[i, 0], x[i, 1]) - 0.055
        movers = min(math.hypot(*(m - x[i, :2])) for m in zip(scenario["mover_x"][i], scenario["mover_y"][i], strict=True)) - 0.11
        true = min(walls, movers)
        if blocked[i][cell_of(task, x[i, 0], x[i, 1])]:
            assert clear[i] < 0.0
        elif true < 0.3:  # nearer than the cells around its own reach
            assert clear[i] == pytest.approx(true, abs=1e-9)
        else:
            assert 0.3 <= clear[i] <= true + 1e-9


def test_a_crash_is_a_negative_clearance() -> None:
    task, rng = grid(), np.random.default_rng(11)
    scenario = task.draw(rng, 20_000)
    x = np.stack([rng.uniform(-1.9, 1.9, 20_000), rng.uniform(-1.3, 1.3, 20_000), np.zeros(20_000)], axis=1)
    tally = task.observe(task.begin(scenario), x, scenario)
    assert np.array_equal(task.safety(tally) == -1.0, task.clearance(x, scenario) < 0.0)
    far = np.array([[50.0, -70.0, 0.0]]).repeat(20_000, axis=0)
    assert np.all(task.safety(task.observe(task.begin(scenario), far, scenario)) == -1.0)


def drive(task: Task, scenario: Scenario, path: list[np.ndarray], rng: np.random.Generator) -> tuple[Any, list[Scenario]]:
    tally = task.begin(scenario)
    seen = []
    for k, x in enumerate(path):
        scenario = task.advance(scenario, rng) if k else scenario
        seen.append(scenario)
        tally = task.observe(tally, x, scenario)
    return tally, seen


def test_the_metric_is_what_a_slow_reader_of_the_paper_would_compute() -> None:
    task, rng = grid(), np.random.default_rng(12)
    n = 150
    scenario = task.draw(rng, n)
    steps = np.cumsum(rng.normal(0.0, 0.02, (200, n, 3)), axis=0)
    path = [scenario["start"], *(scenario["start"] + step for step in steps)]
    tally, seen = drive(task, scenario, path, rng)
    outcomes = {"crashed": 0, "arrived": 0, "neither": 0}
    for i in range(n):
        blocked = task.view(scenario)["blocked"][i]
        goals = [cell_of(task, *goal) for goal in scenario["goals"][i]]
        lengths = path_lengths(blocked, goals, 0.4)
        score, outcome = 0.0, "neither"
        for x, then in zip(path, seen, strict=True):
            place = x[i, :2]
            near = min(math.hypot(a - place[0], b - place[1]) for a, b in zip(then["mover_x"][i], then["mover_y"][i], strict=True))
            if wall_distance(task, blocked, *place) < 0.055 or near < 0.11:
                score, outcome = -1.0, "crashed"
                break
            here = cell_of(task, *place)
            score = max(lengths[cell_of(task, *path[0][i, :2])] - lengths.get(here, math.inf), 0.0)
            if here in goals:
                outcome = "arrived"
                break
        outcomes[outcome] += 1
        assert task.safety(tally)[i] == pytest.approx(score)
        assert task.done(tally)[i] == (outcome != "neither")
        if score >= 0.0:
            assert task.progress(tally)[i] == pytest.approx(score)
    assert min(outcomes.values()) > 0


def test_nothing_counts_once_the_outcome_is_settled() -> None:
    task, rng = grid(movers=0), np.random.default_rng(13)
    scenario = task.draw(rng, 50)
    goal = np.concatenate([scenario["goals"][:, 0], np.zeros((50, 1))], axis=1)
    outside = np.full((50, 3), 9.0)
    arrived, _ = drive(task, scenario, [scenario["start"], goal, outside], rng)
    assert np.all(task.done(arrived))
    assert np.array_equal(task.safety(arrived), task.begin(scenario).start_distance)
    crashed, _ = drive(task, scenario, [scenario["start"], outside, goal], rng)
    assert np.all(task.safety(crashed) == -1.0)


def test_standing_still_is_no_pass() -> None:
    task, rng = grid(), np.random.default_rng(14)
    scenario = task.draw(rng, 100)
    tally, _ = drive(task, scenario, [scenario["start"]] * 3, rng)
    assert np.all(task.safety(tally) == 0.0)
    assert not task.progress_ok(task.progress(tally))
    assert task.progress_ok(np.array([0.0, 0.4, 0.8]))


# ---------------------------------------------------------------- keep-out


def test_keep_out_starts_clear_and_measures_the_least_clearance() -> None:
    task, rng = KeepOut({}, UNICYCLE, DT), np.random.default_rng(15)
    n = 300
    scenario = task.draw(rng, n)
    theta = task.view(scenario)
    path = [scenario["start"], *(scenario["start"] + step for step in np.cumsum(rng.normal(0.0, 0.05, (80, n, 3)), axis=0))]
    tally, _ = drive(task, scenario, path, rng)
    for i in range(n):
        (disc_x, disc_y), (goal_x, goal_y) = theta["disc"][i], theta["goal"][i]
        least, last = math.inf, math.inf
        for k, x in enumerate(path):
            a, b = x[i, 0], x[i, 1]
            last = math.hypot(a - goal_x, b - goal_y)
            least = min(least, math.hypot(a - disc_x, b - disc_y) - 0.305, 1.545 - abs(a), 0.945 - abs(b))
            if k == 0:
                first = last
                assert least >= 0.05 - 1e-12
                assert first >= 0.9
            if last <= 0.1:
                break
        assert task.safety(tally)[i] == pytest.approx(least)
        assert task.progress(tally)[i] == pytest.approx(min(max((first - last) / (first - 0.1), 0.0), 1.0))


def test_keep_out_is_drawn_around_the_robot() -> None:
    task, rng = KeepOut({}, UNICYCLE, DT), np.random.default_rng(16)
    at = np.array([0.4, -0.3, 2.0])
    scenario = task.draw_at(rng, at)
    assert scenario["start"].tolist() == [at.tolist()]
    assert task.clearance(at[None], scenario)[0] >= 0.05
    with pytest.raises(NotEnoughEvidence, match=r"x 1\.590, y 0\.000 m; scenarios start in the region"):
        task.draw_at(rng, np.array([1.59, 0.0, 0.0]))
    with pytest.raises(NotEnoughEvidence, match="x nan"):
        task.draw_at(rng, np.array([math.nan, 0.0, 0.0]))


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("task", "parameters", "words"),
    [
        (GridWorld, {"movrs": 3.0}, "task grid_world: has no parameter 'movrs'; did you mean 'movers'"),
        (GridWorld, {"rows": 2.5}, "rows is 2.5, must be a whole number >= 1"),
        (GridWorld, {"cell": 0.0}, "cell is 0, must be > 0 m"),
        (GridWorld, {"robot_radius": 0.2}, "robot_radius is 0.2, must be > 0 m and below half a cell"),
        (GridWorld, {"turn": 1.5}, "turn is 1.5, must be a probability"),
        (GridWorld, {"static": 34.0}, "take 41 cells, there are 40"),
        (GridWorld, {"mover_speed": math.nan}, "mover_speed is nan, must be a finite number"),
        (KeepOut, {"x_high": -2.0}, "task keep_out: x_high is -2, must be above x_low"),
        (KeepOut, {"min_progress": 2.0}, "min_progress is 2, must be between 0 and 1"),
        (KeepOut, {"disc_radius": True}, "disc_radius is True, must be a finite number"),
    ],
)
def test_a_bad_parameter_is_named_with_what_it_must_be(task: Any, parameters: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        task(parameters, UNICYCLE, DT)


@pytest.mark.parametrize("task", [GridWorld, KeepOut])
def test_a_model_without_a_place_is_refused(task: Any) -> None:
    with pytest.raises(ConfigError, match="'joint' lacks x, y"):
        task({}, JOINT, DT)


def test_a_law_without_scenarios_is_refused() -> None:
    with pytest.raises(ConfigError, match="no layout with a way to a goal was found"):
        grid(columns=3, rows=1, goals=1, static=0, movers=1, clear_cells=3).draw(np.random.default_rng(17), 2)
    with pytest.raises(ConfigError, match="no scenario was found"):
        KeepOut({"disc_radius": 3.0}, UNICYCLE, DT).draw(np.random.default_rng(18), 1)
