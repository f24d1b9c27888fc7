"""What an answer is worth, given the truth: one word a set.

    clean      clean | alarm
    one, pair  right | tie (ambiguous, the truth among what is named) | none | withheld (unexplained: no name was lent)
               | fault (sensor_fault) | part (some of a pair, nothing false) | wrong (a false name among those given)
    outside    flagged (unexplained) | named_flagged (a name, and depends_on says that more is left) | false_name | none | fault
    tie        tie | overclaimed (one of several, as if it were sure) | wrong | none | withheld | fault
    fault      found (sensor_fault, and where) | located (where, under another verdict) | missed | wrong (a name)
    fault_effect   as `one`
    reversed   right | tie | honest (unexplained; or refused) | none | fault | wrong. The sign of an input is wrong
    unpromised honest (no effect is reported) | false_name
    bad        honest (refused in one line, or no name) | named | accepted (a file without a recording) | crash

In truths with `close`, `off` stands for right effects with a value far from the true one; in those with `no_fault`, a fault of these kinds
is an alarm, or wrong.

An answer is what `s2r trace --json` prints. A truth is what NAME.truth.json holds. Both are plain data.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Answer = dict[str, Any]
Truth = dict[str, Any]
Names = list[tuple[str, str]]

INTERVAL_FREE = {"scheme", "from", "matrix"}
"""Parameters whose intervals are not counted one by one."""


def named(effects: list[dict[str, Any]]) -> Names:
    """(name, channel) of each."""
    return [(e["name"], e["channel"]) for e in effects]


def is_one_of(found: tuple[str, str], names: list[list[str | None]]) -> bool:
    """Whether a found name is among the accepted ones; no channel means any."""
    return any(found[0] == name and channel in {None, found[1]} for name, channel in names)


def outcome(truth: Truth, answer: Answer) -> str:
    """One word."""
    from trace_sets.log_scoring import close, false_fault

    if false_fault(truth, answer):
        return "alarm" if truth["expect"] == "clean" else "wrong"
    if truth["expect"] == "unpromised":
        return "false_name" if answer["verdict"] in {"traced", "ambiguous"} else "honest"
    if truth["expect"] == "clean":
        return _of_clean(truth, answer)
    if truth["expect"] == "outside":
        return _of_outside(answer)
    if truth["expect"] == "fault":
        return _of_fault(truth, answer)
    if truth["expect"] == "bad":
        return "accepted" if truth["must_refuse"] else "named" if answer["verdict"] in {"traced", "ambiguous"} else "honest"
    word = _of_named(truth, answer)
    if truth["expect"] == "reversed" and word == "withheld":
        return "honest"
    if word == "right" and truth.get("close") and not close(truth, answer):
        return "off"
    return "overclaimed" if truth["expect"] == "tie" and word in {"right", "part"} else word


def _of_clean(truth: Truth, answer: Answer) -> str:
    """Coloured noise may be called so; spikes may be called faults where there are some."""
    verdict = answer["verdict"]
    if verdict == "none":
        return "clean"
    if verdict == "unexplained" and set(answer["depends_on"]) <= {"noise"} and truth["noise"] == "coloured":
        return "clean"
    heavy = truth["noise"] in {"outliers", "student"}
    if verdict == "sensor_fault" and heavy and all(f["kind"] in {"spike", "dropout"} for f in answer["faults"]):
        return "clean"
    return "alarm"


def _of_outside(answer: Answer) -> str:
    verdict = answer["verdict"]
    if verdict == "unexplained":
        return "flagged"
    if verdict in {"none", "sensor_fault"}:
        return "none" if verdict == "none" else "fault"
    return "named_flagged" if set(answer["depends_on"]) - {"noise"} else "false_name"


def _of_named(truth: Truth, answer: Answer) -> str:
    verdict, accepted = answer["verdict"], truth["accepted"]
    if verdict in {"none", "unexplained", "sensor_fault"}:
        return {"none": "none", "unexplained": "withheld", "sensor_fault": "fault"}[verdict]
    words = [_against(names, answer) for names in (accepted, *truth.get("alternatives", []))]
    return next((word for word in ("right", "tie", "part") if word in words), "wrong")


def _against(accepted: list[list[list[str | None]]], answer: Answer) -> str:
    found = named(answer["effects"])
    if answer["verdict"] == "ambiguous":
        among = found + named(answer["ambiguous_with"])
        return "tie" if all(any(is_one_of(f, names) for f in among) for names in accepted) else "wrong"
    if None in matching(found, accepted):
        return "wrong"
    return "right" if len(found) == len(accepted) else "part"


def _of_fault(truth: Truth, answer: Answer) -> str:
    verdict = answer["verdict"]
    if verdict in {"traced", "ambiguous"}:
        return "wrong"
    if not located(truth, answer):
        return "missed"
    only_gaps = all(f["kinds"] == ["dropout"] for f in truth["true_faults"])
    return "found" if verdict == "sensor_fault" or (only_gaps and verdict == "none") else "located"


def located(truth: Truth, answer: Answer) -> bool:
    """Whether at least four of five true faults are told, under a name that fits, on that channel, about there and then."""
    step = 1.0 / truth["rate"]
    there = [any(_meets(true, told, step) for told in answer["faults"]) for true in truth["true_faults"]]
    return sum(there) >= 0.8 * len(there)


def _meets(true: dict[str, Any], told: dict[str, Any], step: float) -> bool:
    if told["kind"] not in true["kinds"] or (true["channel"] not in {"*", told["channel"]} and told["channel"] != "*"):
        return False
    slack = 3.0 * step
    both = min(true["to_s"], told["to_s"]) - max(true["from_s"], told["from_s"])
    either = max(true["to_s"], told["to_s"]) - min(true["from_s"], told["from_s"])
    return bool(both + slack >= 0.5 * (either - 2.0 * slack) and both >= -slack)


def matching(found: Names, accepted: list[list[list[str | None]]]) -> list[int | None]:
    """For each found effect, which missing one it is; each at most once."""
    left = list(range(len(accepted)))
    matched: list[int | None] = []
    for f in found:
        place = next((i for i in left if is_one_of(f, accepted[i])), None)
        if place is not None:
            left.remove(place)
        matched.append(place)
    return matched


def depends_right(truth: Truth, answer: Answer) -> bool:
    """Whether the first thing that the answer says it depends on is true."""
    tokens = [t for t in answer["depends_on"] if t != "noise" or "noise" in truth["depends_on"]]
    return bool(tokens) and tokens[0] in truth["depends_on"]


def covered(truth: Truth, answer: Answer) -> list[tuple[str, bool]]:
    """For each parameter with a 95 % interval that goes by the truth's own name: whether the truth lies in it."""
    if answer["verdict"] not in {"traced", "ambiguous"}:
        return []
    told = []
    for effect, name, true, value in own_values(truth, answer):
        low, high = value["low"], value["high"]
        if isinstance(low, float | int) and isinstance(high, float | int):
            told.append((f"{effect}.{name}", bool(low <= true <= high)))
    return told


def own_values(truth: Truth, answer: Answer) -> Iterator[tuple[str, str, float, dict[str, Any]]]:
    """(effect, parameter, true value, what is said of it) for each parameter that goes by the truth's own name, as far as inputs went."""
    pairs = zip(answer["effects"], matching(named(answer["effects"]), truth.get("accepted", [])), strict=True)
    for effect, place in pairs:
        if place is None or place >= len(truth["effects"]) or truth["effects"][place]["name"] != effect["name"]:
            continue
        if {truth["effects"][place]["channel"], effect["channel"]} == {"world", "body"}:
            continue  # the same push, along other axes
        true = truth["effects"][place]["parameters"]
        for name, value in effect["parameters"].items():
            if name in INTERVAL_FREE or name not in true:
                continue
            if name not in {"low", "high"} or abs(true[name]) <= truth["unreached"].get(effect["channel"], float("inf")):
                yield effect["name"], name, true[name], value
