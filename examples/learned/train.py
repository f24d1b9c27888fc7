"""Trains a small policy on the grid task and writes it as ONNX: python examples/learned/train.py FOLDER

It imitates controllers/grid.py with a wide margin (imitation learning with aggregation of data: Ross, Gordon, Bagnell, DAgger, 2011).
Each round drives the task's scenarios with the present network, labels the visited states with what the teacher would do, and fits again.

    observations    x, y, theta, distance of every cell to the nearest goal
    features (8)    place in the cell (2), sin and cos of the heading, which of the four neighbouring cells is nearer to a goal (4)
    network         8 -> 48 -> 48 -> 2, tanh; its outputs are scaled to m/s and rad/s by the settings

The features are part of the ONNX graph, so the runtime knows nothing of them. Seeded: the same machine writes the same bytes.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import compose
from s2r_runtime.plugins import registry
from s2r_runtime.profile.load import load_profile

HERE = Path(__file__).parent
SEED, ROUNDS, SCENARIOS, EPOCHS, BATCH, HIDDEN = 7, 8, 150, 12, 256, 48
SPEED, TURN = 0.15, 2.5  # m/s and rad/s: the network's outputs are in these units
TEACHER = {"margin": 0.145, "speed": SPEED, "max_turn": TURN}  # to the middle of each cell: room for the student's errors


def main(folder: Path) -> None:
    """Trains, and writes grid_policy.onnx."""
    rng = np.random.default_rng(SEED)
    profile = load_profile(HERE / "grid.toml")
    model = compose(profile.model)
    task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    teacher, grid = load_teacher(), task.grid
    weights = begin(rng)

    def student(x, theta):
        return drive(weights, x, theta, grid)

    inputs, targets = np.empty((0, 8)), np.empty((0, 2))
    for number in range(ROUNDS):
        x, theta = visited(rng, task, model, teacher if number == 0 else student)
        inputs = np.concatenate([inputs, features(x, theta, grid)])
        targets = np.concatenate([targets, teacher(x, theta) / [SPEED, TURN]])
        loss = fit(rng, weights, inputs, targets, EPOCHS * (3 if number == ROUNDS - 1 else 1))
        print(f"round {number + 1} of {ROUNDS}: {len(inputs)} states, mean squared error {loss:.4f}")
    folder.mkdir(parents=True, exist_ok=True)
    onnx.save(graph(weights, grid), folder / "grid_policy.onnx")


def load_teacher():
    """control(x, theta) of controllers/grid.py."""
    scope: dict = {}
    exec((HERE.parent.parent / "controllers" / "grid.py").read_text(encoding="utf-8"), scope)  # noqa: S102 - the project's own
    parameters = {**scope["PARAMETERS"], **TEACHER}
    return lambda x, theta: scope["control"](x, theta, parameters)


def visited(rng, task, model, control):
    """States (n, 3) and what the task shows in each, from rollouts with disturbances; until each scenario is over."""
    scenario = task.draw(rng, SCENARIOS)
    x, hidden = np.asfortranarray(scenario["start"]), model.at_rest(SCENARIOS)
    tally = task.observe(task.begin(scenario), x, scenario)
    states, views = [], []
    for k in range(task.horizon):
        theta, live = task.view(scenario), ~task.done(tally)
        if not live.any():
            break
        if k % 3 == 0:
            states.append(x[live])
            views.append({name: value[live] for name, value in theta.items()})
        x, hidden = model.step(x, control(x, theta), hidden)
        x = x + rng.normal(0.0, [0.002, 0.002, 0.03], x.shape)
        x[:, 2] = wrap(x[:, 2])
        scenario = task.advance(scenario, rng)
        tally = task.observe(tally, x, scenario)
    return np.concatenate(states), {name: np.concatenate([view[name] for view in views]) for name in views[0]}


def features(x, theta, grid):
    """(n, 8): as the ONNX graph computes them."""
    width, rows = grid.columns + 2, grid.rows + 2
    across, up = (x[:, 0] - grid.left) / grid.cell + 1.0, (x[:, 1] - grid.bottom) / grid.cell + 1.0
    column, row = np.floor(np.clip(across, 1.0, width - 1.5)), np.floor(np.clip(up, 1.0, rows - 1.5))
    at = (row * width + column).astype(np.int64)
    cells = at[:, None] + np.array([0, 1, width, -1, -width])
    distance = np.take_along_axis(np.clip(theta["distance"].reshape(len(x), -1), 0.0, 100.0), cells, axis=1)
    nearer = (distance[:, 1:] < distance[:, :1]).astype(float)
    place = np.column_stack([across - column - 0.5, up - row - 0.5])
    return np.column_stack([2.0 * place, np.sin(x[:, 2]), np.cos(x[:, 2]), nearer])


def begin(rng):
    """Weights and biases of three layers."""
    sizes = (8, HIDDEN, HIDDEN, 2)
    return [part for a, b in itertools.pairwise(sizes) for part in (rng.normal(0.0, a**-0.5, (a, b)), np.zeros(b))]


def forward(weights, z):
    """Activations of each layer, the last one linear."""
    layers = [z]
    for k in range(0, len(weights), 2):
        z = layers[-1] @ weights[k] + weights[k + 1]
        layers.append(np.tanh(z) if k + 2 < len(weights) else z)
    return layers


def drive(weights, x, theta, grid):
    """The network's u (n, 2), as it will be limited."""
    return np.clip(forward(weights, features(x, theta, grid))[-1], [0.0, -1.0], 1.0) * [SPEED, TURN]


def fit(rng, weights, inputs, targets, epochs):
    """Adam (Kingma and Ba, 2015) on the mean squared error, in place. Returns the last epoch's mean."""
    first, second, step, loss = [np.zeros_like(w) for w in weights], [np.zeros_like(w) for w in weights], 0, 0.0
    for epoch in range(epochs):
        order, losses = rng.permutation(len(inputs)), []
        rate = 3e-3 * (1.0 - epoch / epochs) + 1e-4
        for part in np.array_split(order, max(1, len(order) // BATCH)):
            layers = forward(weights, inputs[part])
            error = layers[-1] - targets[part]
            losses.append(float(np.mean(error**2)))
            gradient, back = [np.zeros(0)] * len(weights), 2.0 * error / error.size
            for k in range(len(weights) - 2, -1, -2):
                gradient[k], gradient[k + 1] = layers[k // 2].T @ back, back.sum(axis=0)
                if k:
                    back = (back @ weights[k].T) * (1.0 - layers[k // 2] ** 2)
            step += 1
            for w, g, m, v in zip(weights, gradient, first, second, strict=True):
                m += 0.1 * (g - m)
                v += 0.001 * (g * g - v)
                w -= rate * (m / (1.0 - 0.9**step)) / (np.sqrt(v / (1.0 - 0.999**step)) + 1e-8)
        loss = float(np.mean(losses))
    return loss


def graph(weights, grid):
    """The ONNX model: (n, 3 + cells) observations -> (n, 2)."""
    width, rows = grid.columns + 2, grid.rows + 2
    cells = width * rows
    constants, nodes = {}, []

    def constant(name, value, kind=np.float32):
        constants[name] = numpy_helper.from_array(np.array(value, dtype=kind), name)
        return name

    def node(kind, inputs, output, **attributes):
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    for name, (begin_, end) in {"xy": (0, 2), "heading": (2, 3), "distance": (3, 3 + cells)}.items():
        span = [constant(f"{name}_{what}", [value], np.int64) for what, value in (("from", begin_), ("to", end), ("axis", 1))]
        node("Slice", ["observations", *span], name)
    node("Sub", ["xy", constant("corner", [grid.left - grid.cell, grid.bottom - grid.cell])], "from_corner")
    node("Div", ["from_corner", constant("cell", grid.cell)], "in_cells")
    node("Max", ["in_cells", constant("first", [1.0, 1.0])], "not_below")
    node("Min", ["not_below", constant("last", [width - 1.5, rows - 1.5])], "inside")
    node("Floor", ["inside"], "cell_of")
    node("Sub", ["in_cells", "cell_of"], "in_cell")
    node("Sub", ["in_cell", constant("half", 0.5)], "from_middle")
    node("Mul", ["from_middle", constant("two", 2.0)], "place")
    node("MatMul", ["cell_of", constant("strides", [[1.0], [width]])], "flat")
    node("Cast", ["flat"], "flat_index", to=TensorProto.INT64)
    node("Add", ["flat_index", constant("around", [[0, 1, width, -1, -width]], np.int64)], "indices")
    node("GatherElements", ["distance", "indices"], "near", axis=1)
    for name, (begin_, end) in {"here": (0, 1), "there": (1, 5)}.items():
        span = [constant(f"{name}_{what}", [value], np.int64) for what, value in (("from", begin_), ("to", end), ("axis", 1))]
        node("Slice", ["near", *span], name)
    node("Less", ["there", "here"], "is_nearer")
    node("Cast", ["is_nearer"], "nearer", to=TensorProto.FLOAT)
    node("Sin", ["heading"], "sin")
    node("Cos", ["heading"], "cos")
    layer = node("Concat", ["place", "sin", "cos", "nearer"], "features", axis=1)
    for k in range(0, len(weights), 2):
        last = k + 2 == len(weights)
        names = [constant(f"weight_{k // 2}", weights[k]), constant(f"bias_{k // 2}", weights[k + 1])]
        layer = node("Gemm", [layer, *names], "commands" if last else f"sum_{k // 2}")
        layer = layer if last else node("Tanh", [layer], f"layer_{k // 2}")
    made = helper.make_graph(
        nodes,
        "grid_policy",
        [helper.make_tensor_value_info("observations", TensorProto.FLOAT, ["n", 3 + cells])],
        [helper.make_tensor_value_info("commands", TensorProto.FLOAT, ["n", 2])],
        list(constants.values()),
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=9, producer_name="s2r_runtime example")
    onnx.checker.check_model(model, full_check=True)
    return model


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python train.py FOLDER")
    main(Path(sys.argv[1]))
