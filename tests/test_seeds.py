"""Nobody can shop for a seed: it is drawn after the attempt is paid for, and what can be known beforehand is never an attempt's."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence import seeds
from s2r_runtime.evidence.bounds import attempt_beta
from s2r_runtime.evidence.probe import behaviour
from s2r_runtime.messages import Tries
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.tasks.keep_out import KeepOut
from s2r_runtime.trust import offline_ledger
from s2r_runtime.trust.offline_ledger import Ledger

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tools"))
import bench_grinding  # noqa: E402 - a tool

MODEL = compose(ModelSpec("unicycle", 0.033))
TASK = KeepOut({}, MODEL.nominal, MODEL.dt)


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    offline_ledger.create(tmp_path / "signing.key")
    return offline_ledger.open_ledger(tmp_path / "signing.key", "rover")


def test_a_seed_is_drawn_once_for_an_attempt_that_stands_in_the_ledger(ledger: Ledger) -> None:
    with pytest.raises(ConfigError, match="attempt 1 was not paid for"):
        ledger.draw_seed(1)
    drawn = [ledger.draw_seed(ledger.spend_attempt("c")) for _ in range(20)]
    assert [entry.seed for entry in ledger.entries()] == drawn
    assert len(set(drawn)) == 20
    with pytest.raises(ConfigError, match="has its seed"):
        ledger.draw_seed(7)


def test_without_a_durable_payment_nothing_is_drawn(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    attempt = ledger.spend_attempt("c")
    with monkeypatch.context() as patch:
        patch.setattr(offline_ledger, "replace", full)
        with pytest.raises(ConfigError, match="nothing may be certified"):
            ledger.spend_attempt("c")
        with pytest.raises(ConfigError, match="nothing may be certified"):
            ledger.draw_seed(attempt)  # one that the ledger did not keep is no seed
    assert [entry.seed for entry in ledger.entries()] == [None]


def test_a_ledger_of_an_earlier_version_goes_on(ledger: Ledger) -> None:
    ledger.spend_attempt("c")
    old = {"robot": "rover", "kind": "attempt", "number": 1, "subject": ["c"], "unix_s": 1}
    assert msgspec.convert(old, offline_ledger.Entry).seed is None
    assert ledger.ended(1, "") == Tries(1, 1, 1)


def test_attempts_on_a_gap_and_controllers_that_differ_are_counted(ledger: Ledger) -> None:
    told = [
        ledger.ended(ledger.spend_attempt(digest, epoch=epoch), acts)
        for digest, epoch, acts in (("a", 1, "x"), ("a", 1, "x"), ("b", 1, "x"), ("c", 1, "y"), ("d", 1, ""), ("a", 2, "x"))
    ]
    assert told == [Tries(1, 1, 1), Tries(2, 2, 1), Tries(3, 3, 1), Tries(4, 4, 2), Tries(5, 5, 3), Tries(6, 1, 1)]


def test_a_comment_is_no_other_behaviour_and_another_gain_is(tmp_path: Path) -> None:
    text = (ROOT / "controllers" / "keep_out.py").read_text(encoding="utf-8")
    found = []
    for name, source in (("a", text), ("b", text + "\n# another comment\n"), ("c", text)):
        (tmp_path / f"{name}.py").write_text(source, encoding="utf-8")
        file = load(tmp_path / f"{name}.py")
        control = batch_control(file)
        changed = (lambda x, theta, control=control: 0.9 * control(x, theta)) if name == "c" else control
        found.append((file.digest, behaviour(changed, TASK, MODEL, ((-0.2, 0.2), (-3.0, 3.0)))))
    assert len({digest for digest, _ in found}) == 2
    assert found[0][1] == found[1][1] != found[2][1]


def test_the_quick_program_of_the_bench_foretells_verifications_whose_seed_is_known() -> None:
    known = [bench_grinding.seed_of_before(f"{number}", 1) for number in range(400)]
    predicted = [bench_grinding.passes(seed) for seed in known]
    assert any(predicted)
    assert [bench_grinding.verified(seed, "c", 1) for seed in known[:40]] == predicted[:40]


def test_variants_tried_offline_give_certificates_only_where_the_seed_is_known(tmp_path: Path) -> None:
    """At 0.36 % a try, 60 owners of 100 variants each have 0.2 certificates to expect, and 18 by the rule of before."""
    assert bench_grinding.certificates(60, 100, 0, tmp_path, before=True) >= 5
    assert bench_grinding.certificates(60, 100, 0, tmp_path, before=False) <= 4
    assert int(np.ceil(np.log(attempt_beta(0.05, 1)) / np.log1p(-0.03))) == bench_grinding.N


def test_a_simulation_repeats_its_seeds() -> None:
    one, same, other = (seeds.simulated(seed) for seed in (1, 1, 2))
    first = [next(one) for _ in range(5)]
    assert first == [next(same) for _ in range(5)]
    assert not set(first) & {next(other) for _ in range(5)}
