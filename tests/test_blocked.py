"""Ordinary driving founds a gap only where the profile vouches for blocks of it, and then the assumption stands on the certificate."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import erf

from s2r_runtime.api.progress import Watcher
from s2r_runtime.api.verification import gap_of, load_recordings
from s2r_runtime.core import ledger
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence import blocked, statements
from s2r_runtime.evidence.bounds import clopper_pearson_lower, sample_size
from s2r_runtime.evidence.gap import blocked as in_blocks
from s2r_runtime.evidence.gap import estimate_gap
from s2r_runtime.files.canonical import digest_of_all, digest_of_path
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Driving, Profile, load_profile, parse_profile
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.recordings.transitions import Drive, Transitions
from s2r_runtime.trust import certificate

DT = 0.1
SETTINGS = {"epsilon": 0.05, "share": 0.0152, "discard": 0}
N = sample_size(0.05, 0.0076)
MODEL = compose(ModelSpec("unicycle", DT))
ROBOTARIUM = Path(__file__).parent.parent / "profiles" / "robotarium.toml"
BECAUSE = "the floor's slip is another one after half a metre"


def drive(t0_s: np.ndarray, stands: slice = slice(0)) -> Transitions:
    """stands: which rows are of a robot that stands still."""
    n = len(t0_s)
    x0, u = np.random.default_rng(0).normal(size=(n, 3)), np.full((n, 2), 0.1)
    x0[stands], u[stands] = 0.0, 0.0
    x1, _ = MODEL.step(x0, u, MODEL.at_rest(n))
    steps = Drive((u,), np.arange(n))
    return Transitions(x0, u, x1, None, 1, False, {}, "sha256:0", t0_s, "drive.csv", doubt="ordinary driving", drive=steps)


def test_the_first_blocks_count_and_no_more_so_that_nobody_stops_when_r_looks_good() -> None:
    vouched = Driving(block=1.0, because=BECAUSE)
    long = blocked.founding(drive(np.arange(10 * (N + 50)) * DT), vouched, DT, **SETTINGS)
    assert (len(long.x0), long.independent, long.rejected["later_blocks"]) == (N, True, 50)
    assert long.t0_s[-1] == pytest.approx(N - 1)
    assert len(long.drive.step) == N
    with pytest.raises(NotEnoughEvidence, match=f"{N} different ones are needed: 3 more") as caught:
        blocked.founding(drive(np.arange(10 * (N - 3)) * DT), vouched, DT, **SETTINGS)
    assert caught.value.missing == 3


def test_copies_are_counted_before_the_blocks_are_taken_so_that_half_of_the_share_pays_for_the_bound() -> None:
    """A robot that stood still for 40 blocks of the first N: 40 blocks more, less the one that it is; without them, 39 are missing."""
    vouched = Driving(block=1.0, because=BECAUSE)
    stands = slice(100, 500)
    found = blocked.founding(drive(np.arange(10 * (N + 300)) * DT, stands), vouched, DT, **SETTINGS)
    gap = estimate_gap(MODEL, found, epsilon=0.05, beta=SETTINGS["share"], weights=(1.0, 1.0, 1.0))
    assert N <= gap.n <= N + N // blocked.STEP + 1
    assert gap.rejected["copies"] == 39
    with pytest.raises(NotEnoughEvidence, match=rf"39 of them copies of others; {N} different ones are needed: 39 more") as caught:
        blocked.founding(drive(np.arange(10 * N) * DT, stands), vouched, DT, **SETTINGS)
    assert caught.value.missing == 39
    enough = 0.5 * SETTINGS["share"] / (N + 38)
    long = drive(np.arange(10 * (N + 300)) * DT, stands)
    assert blocked.founding(long, Driving(1.0, 0.99 * enough, BECAUSE), DT, **SETTINGS).independent
    with pytest.raises(NotEnoughEvidence, match="take longer blocks"):
        blocked.founding(long, Driving(1.0, 1.01 * enough, BECAUSE), DT, **SETTINGS)


def test_an_endless_stop_is_read_in_a_few_passes() -> None:
    with pytest.raises(NotEnoughEvidence, match="1 more"):
        blocked.founding(drive(np.arange(10 * 20_000) * DT, slice(10 * (N - 2), None)), Driving(block=1.0, because=BECAUSE), DT, **SETTINGS)


def test_weak_mixing_is_paid_for_out_of_half_of_the_share() -> None:
    tr = drive(np.arange(10 * N) * DT)
    enough = 0.5 * SETTINGS["share"] / (N - 1)
    assert blocked.founding(tr, Driving(1.0, 0.99 * enough, BECAUSE), DT, **SETTINGS).independent
    with pytest.raises(NotEnoughEvidence, match="take longer blocks"):
        blocked.founding(tr, Driving(1.0, 1.01 * enough, BECAUSE), DT, **SETTINGS)


def test_no_two_transitions_are_nearer_than_a_block_even_behind_a_hole() -> None:
    t = np.arange(1000) * DT
    with_holes = t[~(((t > 9.9) & (t < 10.8)) | ((t > 49.9) & (t < 50.5)))]
    apart = np.diff(in_blocks(drive(with_holes), 1.0, DT).t0_s)
    assert apart.min() >= 1.0 - 1.5 * DT
    assert in_blocks(drive(t), 1.0, DT).t0_s == pytest.approx(np.arange(100))


def test_blocks_of_an_autoregressive_drive_bound_it_as_often_as_they_say_and_neighbours_do_not() -> None:
    """AR(1), rho = .98 a step; blocks of 200 steps, after which a Gaussian AR(1) is independent to 2 % of its correlation."""
    rng = np.random.default_rng(5)
    share, epsilon, drives = 0.05, 0.05, 400
    n = sample_size(epsilon, share)
    missed = {1: 0, 200: 0}
    for _ in range(drives):
        for block in missed:
            z = lfilter([math.sqrt(1 - 0.98**2)], [1.0, -0.98], rng.normal(size=block * n + 1000))[1000::block]
            missed[block] += bool(1.0 - erf(np.abs(z).max() / math.sqrt(2.0)) > epsilon)
    assert clopper_pearson_lower(missed[200], drives, 1e-3) <= share < clopper_pearson_lower(missed[1], drives, 1e-3)


# ---------------------------------------------------------------- in the profile, on the certificate


def with_driving(**driving: object) -> Profile:
    plain = load_profile(ROBOTARIUM)
    return msgspec.structs.replace(plain, driving=Driving(**driving))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("block = 10.0", "driving.because is ''"),
        ('because = "why not"', "driving.because is 'why not'"),
        ('block = 0.01\nbecause = "x"', "driving.block is 0.01"),
        ('block = 10.0\nmixing = 1.5\nbecause = "x"', "driving.mixing is 1.5"),
        ("blocks = 10.0", "driving.blocks is not a known setting; did you mean 'block'"),
    ],
)
def test_an_assumption_is_whole_or_refused(text: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        parse_profile(f"{ROBOTARIUM.read_text()}\n[driving]\n{text}\n", "p.toml", ROBOTARIUM.parent)


def driven_table(path: Path, seconds: int, dt: float, begin: float = 0.0) -> Path:
    """A drive of an exact unicycle whose heading is measured with noise. begin: its first stamp, s."""
    rng = np.random.default_rng(6 + int(begin))
    rows = ["t,x,y,theta,v,w"]
    rows += [f"{begin + i * dt!r},{0.1 * i * dt!r},0.0,{rng.normal(scale=1e-3)!r},0.1,0.0" for i in range(round(seconds / dt))]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_driving_founds_a_gap_only_where_the_profile_vouches_for_blocks(tmp_path: Path) -> None:
    plain = load_profile(ROBOTARIUM)
    plain = msgspec.structs.replace(plain, model=ModelSpec("unicycle", plain.model.dt))
    model = compose(plain.model)
    share = ledger.share(plain.guarantee.beta, 1)
    n = sample_size(plain.guarantee.epsilon, share / 2.0, plain.guarantee.discard)
    table = driven_table(tmp_path / "drive.csv", n + 2, plain.model.dt)
    with pytest.raises(NotEnoughEvidence, match=r"unless the profile vouches for blocks of it: \[driving\]"):
        gap_of(load_transitions(table, model), model, plain, beta=share)
    vouching = msgspec.structs.replace(plain, driving=Driving(block=1.0, mixing=1e-9, because=BECAUSE))
    gap, assumption, _ = gap_of(load_transitions(table, model), model, vouching, beta=share)
    assert (gap.n, gap.hold_periods, gap.beta) == (n, 1, share)
    assert gap.radius > 0.0
    assert "different blocks of 1 s" in assumption
    assert "coefficient of at most 1e-09 a block" in assumption
    assert assumption.endswith(BECAUSE)


def test_a_certificate_that_rests_on_driving_needs_the_profile_that_says_so() -> None:
    vouching = with_driving(block=10.0, because=BECAUSE)

    class Shown(msgspec.Struct):
        shown: tuple[str, ...]

    def problem(profile: Profile, assumption: str) -> str:
        line = f"It stands on 99 transitions; their independence {statements.ASSUMED}: {assumption}."
        return certificate.assumption_problem(Shown((line,) if assumption else ("It stands on 99 transitions.",)), profile)  # type: ignore[arg-type]

    assert problem(vouching, statements.assumption(vouching.driving)) == ""
    assert problem(load_profile(ROBOTARIUM), "") == ""
    assert "the profile makes none" in problem(load_profile(ROBOTARIUM), statements.assumption(vouching.driving))
    assert "another assumption" in problem(with_driving(block=5.0, because=BECAUSE), statements.assumption(vouching.driving))
    assert vouching.digest() != load_profile(ROBOTARIUM).digest()


def test_several_drives_found_one_gap_in_whatever_order_they_are_named(tmp_path: Path) -> None:
    plain = load_profile(ROBOTARIUM)
    plain = msgspec.structs.replace(plain, model=ModelSpec("unicycle", plain.model.dt))
    model = compose(plain.model)
    share = ledger.share(plain.guarantee.beta, 1)
    n = sample_size(plain.guarantee.epsilon, share / 2.0, plain.guarantee.discard)
    vouching = msgspec.structs.replace(plain, driving=Driving(block=1.0, mixing=1e-9, because=BECAUSE))
    drives = [driven_table(tmp_path / f"{k}.csv", n // 2 + 3 + k, plain.model.dt, begin=1e6 * k) for k in range(2)]
    with pytest.raises(NotEnoughEvidence, match="more"):
        gap_of(load_transitions(drives[0], model), model, vouching, beta=share)
    found = []
    for named in (drives, drives[::-1]):
        recorded, digest = load_recordings(named, model, vouching, Watcher())
        gap, _, _ = gap_of(recorded, model, vouching, beta=share)
        assert gap.n == n
        found.append((gap, digest))
    assert found[0] == found[1]
    assert load_recordings(drives[:1], model, vouching, Watcher())[1] == digest_of_all([digest_of_path(drives[0])]) != found[0][1]
