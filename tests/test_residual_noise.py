"""The noise of a residual is what measurement and process noise make of it, and is found again from the residual."""

import numpy as np
import pytest

from s2r_runtime.trace.estimation.noise import Noise, Whitener, colour, estimate, log_density, no_colour, weight
from s2r_runtime.trace.estimation.state_noise import State, of_state


def _residuals(rng, n, q, r, slope):
    """Of x+ = F x + w measured as y = x + e; F = [[1, slope], [0, 1]]."""
    f = np.tile(np.array([[1.0, slope], [0.0, 1.0]]), (n, 1, 1))
    w, e = rng.normal(size=(n, 2)) * np.sqrt(q), rng.normal(size=(n + 1, 2)) * np.sqrt(r)
    return w + e[1:] - np.einsum("kij,kj->ki", f, e[:-1]), f


def test_whitened_residuals_have_unit_covariance_and_no_memory():
    rng, q, r = np.random.default_rng(1), np.array([0.5, 0.1]), np.array([1.0, 2.0])
    n = 20000
    residual, f = _residuals(rng, n, q, r, 0.3)
    joined = np.append(False, np.ones(n - 1, dtype=bool))
    z = Whitener(Noise(q, r), f, joined)(residual)
    limit = 4.0 / np.sqrt(n)  # four standard errors of a correlation
    assert np.allclose(np.cov(z.T), np.eye(2), atol=1.5 * limit)
    for lag in (1, 2, 3):
        assert np.all(np.abs(z[lag:].T @ z[:-lag] / n) < limit)


@pytest.mark.parametrize("pushed", [False, True])
def test_the_likelihood_of_whitening_is_that_of_the_full_covariance(pushed):
    rng, q, r = np.random.default_rng(2), np.array([0.5, 0.1]), np.array([1.0, 2.0])
    residual, f = _residuals(rng, 6, q, r, 0.3)
    push = rng.normal(size=(6, 2)) if pushed else None
    joined = np.array([False, True, True, False, True, True])
    s = np.zeros((12, 12))
    for k in range(6):
        s[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.diag(q + r) + f[k] @ np.diag(r) @ f[k].T
        if push is not None:
            s[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += np.outer(push[k], push[k])
        if joined[k]:
            s[2 * k : 2 * k + 2, 2 * k - 2 : 2 * k] = -f[k] @ np.diag(r)
            s[2 * k - 2 : 2 * k, 2 * k : 2 * k + 2] = (-f[k] @ np.diag(r)).T
    whiten = Whitener(Noise(q, r), f, joined, push=push)
    z = whiten(residual)
    assert float(np.sum(z * z)) == pytest.approx(residual.ravel() @ np.linalg.solve(s, residual.ravel()))
    assert whiten.logdet == pytest.approx(0.5 * np.linalg.slogdet(s)[1])
    several = np.stack([residual, 3.0 * residual[::-1]], axis=2)
    solved = np.linalg.solve(s, several.reshape(12, 2)).reshape(several.shape)
    assert np.allclose(whiten.back(z), solved[:, :, 0], rtol=1e-10)
    assert np.allclose(whiten.back(whiten(several)), solved, rtol=1e-10)


@pytest.mark.parametrize(("q", "r"), [((1e-9, 1e-9), (1.0, 4.0)), ((0.5, 2.0), (1.0, 4.0)), ((3.0, 3.0), (1e-4, 1e-4))])
def test_both_variances_are_found_again(q, r):
    """Their sum's standard error is about 2 % of it at this n; eight times that is never reached by chance."""
    rng, n = np.random.default_rng(3), 5000
    residual, f = _residuals(rng, n, np.array(q), np.array(r), 0.2)
    found = estimate(residual, f, np.append(False, np.ones(n - 1, dtype=bool)), Noise(np.full(2, 1e-12), np.full(2, 1e-12)))
    total = np.array(q) + np.array(r)
    assert np.allclose(found.q, q, atol=0.16 * total.max())
    assert np.allclose(found.r, r, atol=0.16 * total.max())


@pytest.mark.parametrize("near", [None, (1e-3, 1e2)])
def test_the_noise_of_a_state_is_the_most_likely_one(near):
    """No other pair on a fine grid is likelier by more than two hundredths of a nat; of white noise, of measurement noise, of neither."""
    rng, n = np.random.default_rng(6), 300
    joined = np.append(False, rng.random(n - 1) < 0.98)
    for q, r, wander in ((1.0, 0.0, 0.0), (1e-3, 1.0, 0.0), (0.3, 0.3, 0.0), (0.1, 0.1, 3.0)):
        f = 1.0 + 0.1 * rng.normal(size=n)
        e = np.sqrt(r) * rng.normal(size=n + 1)
        x = np.sqrt(q) * rng.normal(size=n) + e[1:] - f * e[:-1] + wander * np.sin(np.arange(n) / 20.0)
        other = np.full(n, 0.01)
        found = of_state(x, f, joined, other, (1e-9, 1e-9), near)
        given = State(x, f, joined, other)
        reached = given.at(tuple(np.log(found))).cost
        grid = np.log(np.geomspace(1e-5, 30.0, 60))
        assert reached < min(given.at((a, b)).cost for a in grid for b in grid) + 0.02


def _still_noisy(seed, n=3000):
    """Residuals of a state that hardly moves and is measured with noise of variance 1, which rows follow on which, and the noise found."""
    residual, f = _residuals(np.random.default_rng(seed), n, np.array([0.01, 0.01]), np.array([1.0, 1.0]), 0.0)
    joined = np.append(False, np.ones(n - 1, dtype=bool))
    floor = Noise(np.full(2, 1e-12), np.full(2, 1e-12))
    return residual, f, joined, floor, estimate(residual, f, joined, floor)


def test_wild_measurements_do_not_change_the_noise():
    """2 % of rows measured 40 deviations off: what came a step before leaves again a step later."""
    residual, f, joined, floor, clean = _still_noisy(4)
    rng = np.random.default_rng(5)
    k = rng.choice(len(residual) - 1, 60, replace=False)
    off = rng.normal(size=(60, 2)) * 40.0
    np.add.at(residual, k, off)
    np.add.at(residual, k + 1, -off)
    wild = estimate(residual, f, joined, floor)
    assert np.allclose(wild.q + wild.r, clean.q + clean.r, rtol=0.2)


def test_few_shocks_do_not_change_the_noise_and_many_are_the_process_s():
    """A shock stays where it took the state, and a filter must follow: at 2 % of rows more noise of the process is likelier by far."""
    residual, f, joined, floor, clean = _still_noisy(4)
    rng = np.random.default_rng(5)
    few, many = residual.copy(), residual.copy()
    few[rng.choice(len(few), 3, replace=False)] += rng.normal(size=(3, 2)) * 40.0
    many[rng.choice(len(many), 60, replace=False)] += rng.normal(size=(60, 2)) * 40.0
    unchanged = estimate(few, f, joined, floor)
    assert np.allclose(unchanged.q + unchanged.r, clean.q + clean.r, rtol=0.2)

    def likelihood(noise):
        whiten = Whitener(noise, f, joined)
        return np.sum(log_density(whiten(many))) - whiten.logdet

    followed = estimate(many, f, joined, floor)
    assert np.all(followed.q > 10.0 * clean.q)
    assert likelihood(followed) > likelihood(clean) + 1000.0


def test_the_weight_is_the_slope_of_the_density_over_the_value():
    z = np.linspace(0.1, 40.0, 200)
    h = 1e-5
    slope = (log_density(z + h) - log_density(z - h)) / (2 * h)
    assert np.allclose(weight(z), -slope / z, rtol=1e-5, atol=1e-9)
    assert weight(np.array([1.0]))[0] > 0.99
    assert weight(np.array([12.0]))[0] < 0.05


def test_colour_is_found_in_coloured_noise_and_none_in_white():
    rng, n = np.random.default_rng(5), 3000
    white = rng.normal(size=(n, 2))
    z = white.copy()
    for k in range(1, n):
        z[k, 1] = 0.7 * z[k - 1, 1] + white[k, 1]
    joined = np.append(False, np.ones(n - 1, dtype=bool))
    found = colour(z, joined)
    assert found.strength[0] < 0.1
    assert found.coefficients[1, 0] == pytest.approx(0.7, abs=0.06)
    left = found(z, joined)
    assert abs(float(left[1:, 1] @ left[:-1, 1])) / n < 4.0 / np.sqrt(n)
    assert np.array_equal(no_colour(2)(z, joined), z)
