"""Every extension point, on one page.

A plug-in is an installed package with an entry point in the group `s2r_runtime`, naming a module that has functions of
these names marked with `@hookimpl`. Each returns a list of *offers*: a name and a way to get the thing, so that nothing
heavy is imported until it is used. Built-in models, effects and tasks come through the same hooks
(`s2r_runtime.builtin`). Names are unique: a plug-in that reuses one is refused, naming both distributions.

    what                               is
    transport                          `s2r_transports`, `Transport`: a robot's protocol. Its robot logs: `s2r_recordings`
    model, effect                      `s2r_models`, `NominalModel`; `s2r_effects`, `Effect`
    task, with its safety metric       `s2r_tasks`, `Task`: the metric is what `safety` says, >= 0 iff safe
    format of files                    `s2r_formats`: named time series, whatever robot they are of
    kit                                `s2r_kits`: how `s2r plugin check` tries what is offered
    controller                         no hook: a Python or ONNX file, named where it is used (its bytes are what a certificate is about)
    recorder, dashboard                no hook: a separate process reads the log while it is written (docs/plugin-reference.md)

    from s2r_runtime.hookspecs import Offer, hookimpl

    @hookimpl
    def s2r_transports() -> list[Offer]:
        return [Offer("my_bus", "my_package.transport:MyTransport", "what it is, in one line")]
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import pluggy

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

GROUP = "s2r_runtime"
API_VERSION = 1
"""A plug-in's module may say for which it was written: `S2R_API_VERSION = 1`. One that was written for another is not used."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class Offer(NamedTuple):
    """`target`: `module:attribute`, imported when first used. The attribute is the class or object the hook asks for.

    `files`: of a transport, the options that name a file (relative to the profile) whose content says what frames mean. Where a profile
    is read, such an option becomes `{"file": as written, "text": content}`: bound into the profile's digest, and attached to the log.

    `normal_form`: of a transport, `module:function`: function(options, option) -> str, what the file that this option names states for
    these options, in a form that does not depend on how it is written; the profile's digest covers that instead of the text, and the
    option gets it as `"stated"`. Raises ConfigError for a file that cannot be used.

    `recognises`: of a recording, `module:function`: function(head) -> bool, whether a file that begins with these bytes (unpacked, up to
    `HEAD_BYTES`) is of this kind, whatever its name.
    """

    name: str
    target: str
    summary: str = ""
    files: tuple[str, ...] = ()
    recognises: str = ""
    normal_form: str = ""


class ReadLog(NamedTuple):
    """What a reader of recordings may return instead of the plain list. notes: one line each, for the person who reads the result: rows
    that could not be used, with their number, and what was assumed.
    """

    stretches: list[Any]
    notes: tuple[str, ...] = ()


HEAD_BYTES = 65536


# ---------------------------------------------------------------- transports


class Transport(Protocol):
    """Turns a robot's protocol into observations and commands. Constructed as `T(options, states, inputs)`; options is the
    profile's `[transport]` table without `name`. Raises ConfigError for a bad option. Construction opens nothing: an audit
    constructs one just to `decode`.

    It may also have
    - `inform(record)`: takes every change of the gate (`GateChanged`) and every refused command (`Decided`), for people who watch on the
      robot's side. Nothing that an audit repeats may depend on it;
    - `anchor(head)`: takes the head of the log's chain (`LogHead`) when the disk has more of it, at most once a second, and the last
      one: to publish, so that somebody else knows where the log must reach;
    - `lines() -> list[str]`: since the last call, for the daemon's journal: what a person should know of the robot.
    """

    OPTIONS: ClassVar[dict[str, str]]
    """Every option and what it means."""

    def open(self) -> None:
        """Connects; returns at once, whether or not the robot is there. Raises ConfigError if it can never be."""

    def fileno(self) -> int:
        """A descriptor that is readable when `receive` has something."""

    def receive(self) -> list[Frame]:
        """What came since the last call, oldest first; never blocks. Queues behind it are bounded; drops are counted in `counters`."""

    def decode(self, frame: Frame) -> list[Observation | ObservationRefused | Command | LinkChanged | OverrideChanged]:
        """What an inbound frame means. Depends on this and earlier frames only, not on the link. Never raises for bad bytes:
        gives an Observation with a `fault`, or nothing for a frame that is not for us. A Command is somebody else's
        (source `external`): it is logged and refused. A non-finite number is a fault.

        What comes in the robot's name and is dropped, because it is an echo, late or another's, is an ObservationRefused: more of
        them than the profile allows close the gate. A second robot under the robot's name is an OverrideChanged of kind `robot_twin`,
        before any observation in the same list (`s2r_runtime.twins` helps to notice one).
        """

    def poll(self, now_ns: int) -> list[LinkChanged]:
        """Called at least every 20 ms with the host's monotonic clock: link lost or back, by the transport's own time-outs."""

    def encode(self, command: Command) -> Frame:
        """The frame that makes the robot apply the command. Raises ValueError if it is not finite or not of shape (nu,).

        The bytes depend on the command and on what was decoded and encoded before, nothing else: an audit repeats it.
        """

    def send(self, frame: Frame) -> None:
        """Hands the frame to the robot; never blocks longer than a few ms; a drop is counted."""

    def counters(self) -> dict[str, int]:
        """received, sent, dropped_in, dropped_out, malformed, lost (gaps in the robot's sequence), and others."""

    def close(self) -> None:
        """Frees everything; may be called twice."""


# ---------------------------------------------------------------- models and effects


class Story(NamedTuple):
    """What the demo does to a built-in robot behind the runtime's back: effects from the start, as the robot names them, and one that
    begins `change_after_s` seconds of its clock after it was told of it, as the controller is about to drive. `permit_s`: of its clock, in
    which a campaign is over.
    """

    effects: tuple[str, ...]
    change: str
    change_after_s: float
    permit_s: float = 3600.0


class Follows(NamedTuple):
    """How a state follows from measured ones: formula(x, rates, parameters) -> (n,); x and rates (per s): name -> (n,)."""

    of: tuple[str, ...]
    formula: Callable[[dict[str, Array], dict[str, Array], dict[str, float]], Array]


class NominalModel(Protocol):
    """One step of `dt`, batched. x: (n, nx), u: (n, nu); all states and inputs in SI units, angles in rad.

    It may also have: `units` (name of a state or input -> SI unit, for reports); `integration` = "euler" if it has a planar pose (x, y,
    theta) that is moved along the heading at the start of the step; `reached` (state -> the input that it is set to at once: such
    a state is compared with the input as it acts at the *end* of the step, the others with its mean over the step); `follows` (state that
    a recording may lack -> the states that it follows from, and how: `Follows`); `uneven` = True: `step` also takes dt as (n,), one a row;
    `linear` = True: `step` is a linear function of x and u together, so that linear feedback has an exact tube (guarantee G13);
    `within` (input, an angle -> below which size it means something, rad: a recording in which it goes beyond is refused).
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    parameters: dict[str, float]
    """Defaults. The model that effects are given has the values actually used here (`models.bound`)."""

    def step(self, x: Array, u: Array, dt: float, parameters: dict[str, float]) -> Array:
        """x one step later, (n, nx); angles need not be wrapped."""


class Parameter(NamedTuple):
    """A parameter of an effect. `neutral`: the value at which the effect is none (None if there is no such value).

    `shape`: rows and columns of a matrix ([[a, b], [c, d]]; low, high, neutral are those of its entries); empty: a number or a word.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None = None
    kink: bool = False
    """Enters with a kink (delay, deadband, limits): its interval comes from the profile likelihood."""
    shape: tuple[int, ...] = ()


class Effect(Protocol):
    """A phenomenon that can be composed into a model's step. Effects apply in the order in which a model lists them.

    Stage `input`: changes the commanded input (n, nu) before the nominal step, with hidden state where it has one.
    Stage `step`: changes the result of the nominal step. Stage `sensor`: what is measured is not the true state; `to_true` and
    `to_measured` are exact inverses, and a model's x is the measured state on both sides of a step. An effect of stage `input` is
    defined by `input_step` and, for long recordings, the same thing over time at once, `input_sequence`; the kit checks that the two agree.

    It may also have
    - `optional`: names of parameters that may be left out; `fuller(p) -> p | None`: values with more of them that do the same;
    - `choices`: parameter -> its words, for one that is not a number; `named`: parameters that say the name of another input;
      `wrong(p) -> str`: what is wrong with values that are each within bounds, or an empty text;
    - `once` = True: a model has at most one of it; `linear` = True: it commutes with other linear effects, so the tracer tries one
      place in the list only; `shift` = True: a pure delay, which commutes with all that has no clock of its own; `additive` = True: what
      it does is a sum over its parameters, in proportion to each one's distance from neutral (a force: as long as nothing stops);
      `homogeneous` = True: it does as much more as all parameters that have a neutral value are farther from it, in one ratio;
    - `same_as(model, channel) -> tuple[tuple[str, str, convert], ...]`: effects that it is identical to on this model: name, channel, and
      a function of its values that gives theirs. The tracer looks for the first of them instead (`effects.classes` has the built-in ones);
    - `simpler(p) -> (name, p)`: the effect with fewer numbers that it is if its own agree, on the same channel;
    - `takes(model, channel) -> tuple[str, ...]`: names of the parameters that it has there (default: all);
    - `frame(model, channel) -> str` (stage `step`), in the order in which they apply: "wheels" if it changes the displacement of each
      wheel, "body" if it changes the motion of the body (before a pose is integrated along it), "sliding" if it depends on that motion,
      "world" if it adds to the motion along the world's axes;
    - `rebound(model, channel, p) -> dict[str, float]` (stage `step`): the model's parameters as they are with it; the next effect that has
      this gets the model with them, so that several together are one model with all of them;
    - `integrates(p) -> str`: it is the scheme by which a pose is integrated; effects see it as the `integration` of their model;
    - `pushes(model, channel) -> bool`, `push(x, axis, model, channel, p) -> Push | None` and `varies`: it is a force on an axis
      (`models.forces`). A model solves for all its forces together, and does not call `after_step`;
    - `push_under(x, u, axis, model, channel, p) -> Push | None`: the push where it also depends on the inputs as they act, u (n, nu). It is
      called instead of `push`, which then says on which axes it acts;
    - `side_by_side` = True: `input_sequence` also takes u (T, runs, nu), many short runs at once;
    - `uneven` = True: `input_sequence` also takes dt as (T,), how long each row lasts (and `start` as (T,), when each begins, where it is
      `timed`), with which runs come one after the other, a row of zeros and REST_S seconds (`models.input_chains`) between two;
      `after_step` also takes dt as (n,). Without it, rows that do not last alike are taken to;
    - `takes_mixed` = True: `input_sequence(..., mixed=True)` is asked where rows are parts of a step: a row within which the input
      changed has the mean of before and after, and is no command of its own;
    - `within_step(dt, p) -> bool`: whether what acts changes within a step although the input is held over it;
    - `at_end(tables, before, model, channel, dt, p) -> Array`: what acts at the end of each step, for states that are what acts
      (`reached`), from what came in, held over it, what acted on average, and what came in at the end (all (..., nu)). before: hidden
      state at the start of a step; where rows come one after the other in time None, or (`timed`) when each begins, (..., 1). dt: s, or
      of each row, (..., 1). Without it a part's mean is taken. With `takes_mixed_ends` = True it is asked with mixed=True as above;
    - `reads(model, channel) -> tuple[str, ...]`: inputs besides the channel on which what acts there depends;
    - `starts(u, model, channel, dt) -> list[dict]`: parameter values from which the tracer begins, given the input that it would
      get, u (T, nu). Without it the tracer begins from a grid over the parameters' bounds;
    - `timed` = True: it depends on the time since the recording's (or the rollout's) start, in s; times below 0 count as 0. Column 0 of
      its hidden state is that time at the start of the step, which `input_step` advances by dt. `input_sequence(..., start=0.0)` gets
      the time of the first row (float, or (runs,) with u (T, runs, nu)), `starts(..., t)` the times of the rows, (T,);
    - `starts_from_residual(residual, t, pushes, model, channel, dt) -> list[dict]`: further values to begin from, for what the input
      alone does not show (a frequency, the time of a change). residual (n, nx): measured less foretold, t (n,): the steps' times in s,
      ascending, gaps allowed; pushes (n, nx): by how much a unit more of the channel's input moves the state over each step. With
      `proportional` = True: by how much the input's own value more of it does. Both may be whitened, alike;
    - `starts_from_states(x, residual, pushes, model, channel, dt) -> list[dict]`: the same for what shows over the states at the steps'
      starts, x (n, nx), such as a period in the position of an axis. The channel is that axis' position or velocity; pushes are those
      of the input that is the force on it. It has an `amplitude` and a `phase` (rad), which are then fitted to the residual.
    """

    name: str
    stage: str
    """`input`, `step` or `sensor`."""
    parameters: tuple[Parameter, ...]

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The channels on which it makes sense on this model (names of inputs or states, or `*`); empty: not at all."""

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """The parameter's SI unit on this channel (`input` in a Parameter's unit stands for that channel's unit)."""

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: dict[str, Any]) -> Array:
        """Hidden state after a long time at zero input, (n, nh); nh may be 0."""

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: dict[str, Any]) -> tuple[Array, Array]:
        """u as commanded over this step -> u as it acts, averaged over the step; and the next hidden state. A step may be taken in parts:
        it is their mean.
        """

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: dict[str, Any]) -> Array:
        """u (T, nu), one row a step of dt from rest -> what acts, (T, nu). Same as `input_step` T times."""

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float, p: dict[str, Any]) -> Array:
        """Stage `step`: the nominal result x_next (n, nx) -> the result with the effect. x: the true state, u: what acted."""

    def to_true(self, x: Array, model: NominalModel, channel: str, p: dict[str, Any]) -> Array:
        """Stage `sensor`: measured states (n, nx) -> true ones. Angles are not wrapped, here and in `to_measured`."""

    def to_measured(self, x: Array, model: NominalModel, channel: str, p: dict[str, Any]) -> Array:
        """Stage `sensor`: true states (n, nx) -> measured ones. Measured less true is the sensor's offset."""


# ---------------------------------------------------------------- tasks

Scenario = dict[str, Any]
"""Named arrays whose first axis is the rollout, (n, ...)."""


class Task(Protocol):
    """A law of scenarios, a horizon and a safety metric (>= 0 iff safe). Constructed as `T(parameters, model, dt)` where
    parameters is the profile's `[task.parameters]`; raises ConfigError for a bad one. All randomness from the `rng`
    passed in (numpy Generator); batched over the rollouts.

    A task may say what is safe within a distance, and then a scenario can be enclosed (guarantee G13). `position`: names of the states
    that are a place, m. `enclosed(x, reach, scenario, threshold)`: two arrays (n,) of bool, or None where it cannot say. First: the
    safety value stays at `threshold` or above as far as this step goes, for every state whose place is within `reach`, m, of x (n, nx),
    whatever its other states. Second: a run that is in such a state is over at this step.
    """

    name: str
    horizon: int
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]]
    """Every parameter: default and meaning. Most are numbers; a text, a list of numbers or a table may be one too."""

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """n scenarios from the law, independent; each holds `start`, (n, nx)."""

    def draw_at(self, rng: np.random.Generator, x: Array) -> Scenario:
        """One scenario from the law given that the robot is at x (nx,): for driving scenario after scenario."""

    def advance(self, scenario: Scenario, rng: np.random.Generator) -> Scenario:
        """The scenario one step later (what moves, moves)."""

    def view(self, scenario: Scenario) -> Scenario:
        """What a controller may see of it now (`theta` of its entry)."""

    def clearance(self, x: Array, scenario: Scenario) -> Array | None:
        """Distance to the nearest unsafe set, (n,), negative inside; None if the task has no such function."""

    def begin(self, scenario: Scenario) -> Any:
        """A tally that `observe` updates."""

    def observe(self, tally: Any, x: Array, scenario: Scenario) -> Any:
        """Takes note of the states at this step, (n, nx)."""

    def safety(self, tally: Any) -> Array:
        """Safety value so far, (n,)."""

    def progress(self, tally: Any) -> Array:
        """Progress so far, (n,), in the task's unit; `progress_ok` judges it."""

    def done(self, tally: Any) -> NDArray[np.bool_]:
        """Rollouts whose outcome can't change any more, (n,)."""

    def progress_ok(self, progress: Array) -> bool:
        """Whether the rollouts together did what the task is for: standing still is no pass."""


# ---------------------------------------------------------------- the hooks


@hookspec
def s2r_transports() -> list[Offer]:
    """Classes with the interface of `Transport`."""
    return []


@hookspec
def s2r_models() -> list[Offer]:
    """Objects with the interface of `NominalModel`."""
    return []


@hookspec
def s2r_effects() -> list[Offer]:
    """Objects with the interface of `Effect`."""
    return []


@hookspec
def s2r_tasks() -> list[Offer]:
    """Classes with the interface of `Task`."""
    return []


@hookspec
def s2r_recordings() -> list[Offer]:
    """Readers of recordings in robots' own formats. An offer's name is `TRANSPORT.SUFFIX` (`can.blf`): the transport whose options
    the reader understands, and the files that it reads (`.gz` behind the suffix is the reader's to unpack). A file belongs to the offers
    that recognise its content; only if there are none, its suffix decides (never `.csv`, which is a table's). The attribute is a function

        read(path, states, inputs, options) -> [((t_states, x), (t_inputs, u)), ...], or a `ReadLog` of that list and notes

    states, inputs: the model's names. options: the profile's `[transport]` table without `name`, as a transport gets it; empty where the
    profile is of another transport. A list of contiguous stretches; t (N,) s, ascending, of one clock; x (N, nx), u (M, nu) in SI units,
    NaN where a column was not received at that stamp. Raises ConfigError for bad or missing options, RecordingError for a file that
    can't be read.
    """
    return []


@hookspec
def s2r_formats() -> list[Offer]:
    """Readers of files that hold named time series, whatever robot they are of. An offer's name is that of a form in
    `formats.recognise`, which recognises files by their content. The attribute is a function `open(path) -> Opened`
    (`formats.series.Opened`: its topics, and samples of the fields that are wanted). Raises RecordingError for a file that can't be read,
    ImportError where its library is not installed.

    An offer with the name of one of `s2r_recordings` reads the same logs by named signals, where the user names them. Its `files` are
    options that name a file which describes the messages: `open(path, dbc=...)`.
    """
    return []


@hookspec
def s2r_kits() -> list[Offer]:
    """Kits (`s2r_runtime.testing`) with what is needed to run them, for `s2r plugin check`. An offer's name is `KIND.NAME`
    (`transports.my_bus`), with further words where there are several (`transports.my_bus.serial`); the attribute is a subclass of
    `TransportKit`, `ModelKit`, `EffectKit` or `TaskKit`. A transport needs one: nobody else has its robot's end. For models, effects
    and tasks there is a kit without one, on values of its own.
    """
    return []


@hookspec
def s2r_robots() -> list[Offer]:
    """Built-in robots for `s2r demo`: objects with

    `command(seed, effects, connect) -> list[str]`, the argv that starts one (raises ConfigError if something is not installed);
    `profile_text(robot_listen, controller_listen) -> str`; `controller(name) -> Path` of `good` and `reckless`; `profile`, a name;
    `story`, a `Story`.
    """
    return []
