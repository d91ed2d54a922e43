"""Means and standard deviations of results, against closed forms and Monte Carlo runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import design, material, rod as R
from sorojax.math.lie import SE2
from sorojax.units import mm

MIXED = np.random.default_rng(3).normal(size=(3, 3))
COVARIANCE = MIXED @ MIXED.T
SLOPE = jnp.array([1.0, -2.0, 0.5])


def tree(x):
    return {"a": x[0], "b": x[1:]}


def flat(p):
    return jnp.concatenate([p["a"][None], p["b"]])


def test_a_linear_function_has_its_closed_form():
    found = design.propagate_covariance(
        lambda p: SLOPE @ flat(p) + 3.0, tree(jnp.ones(3)), covariance=COVARIANCE
    )
    assert np.isclose(found.mean, 2.5)
    assert np.isclose(found.deviation**2, SLOPE @ COVARIANCE @ SLOPE)
    second = design.propagate_covariance(
        lambda p: SLOPE @ flat(p) + 3.0, tree(jnp.ones(3)), covariance=COVARIANCE, order=2
    )
    assert np.allclose([second.mean, second.deviation], [found.mean, found.deviation])
    alone = design.propagate_covariance(
        lambda p: SLOPE @ flat(p), tree(jnp.ones(3)), deviation=tree(jnp.array([1.0, 2.0, 0.0]))
    )
    assert np.isclose(alone.deviation, np.sqrt(1 + 16))
    assert np.isclose(alone.shares["a"], 1 / 17)
    assert np.allclose(alone.shares["b"], [16 / 17, 0])


def test_a_quadratic_function_has_its_moments_to_second_order():
    """Against the moments of its characteristic numbers, a sum of chi-square variables."""
    matrix = jnp.array([[2.0, 0.3, 0.0], [0.3, -1.0, 0.2], [0.0, 0.2, 0.7]])
    half = np.linalg.cholesky(COVARIANCE)
    weights = np.linalg.eigvalsh(half.T @ np.asarray(matrix) @ half)

    def bowl(x):
        return x @ matrix @ x

    found = jax.jit(
        lambda x: design.propagate_covariance(bowl, x, covariance=COVARIANCE, order=2)
    )(jnp.zeros(3))
    assert np.isclose(found.mean, weights.sum())
    assert np.isclose(found.deviation, np.sqrt(2 * (weights**2).sum()))
    first = design.propagate_covariance(bowl, jnp.zeros(3), covariance=COVARIANCE)
    assert first.mean == 0 and first.deviation == 0 and np.all(first.shares == 0)


def finger(p):
    """A finger held level that its weight and a wrench bend: height of the tip [m]."""
    body = R.rod(
        SE2(),
        R.constant("kappa_z"),
        R.circle(5 * mm),
        length=0.1 * p["length"],
        young_modulus=1e6 * p["modulus"],
        poisson_ratio=0.4,
        density=1100.0,
        nodes=6,
    )
    rest = R.equilibrium(body, (R.Gravity([0.0, -9.81]),), max_iterations=20)
    return R.tip_pose(body, rest.q)[1, 2]


MEAN = {"length": jnp.asarray(1.0), "modulus": jnp.asarray(1.0)}
SIGMA = {"length": jnp.asarray(0.02), "modulus": jnp.asarray(0.05)}


def runs(function, count=1000):
    keys = jax.random.split(jax.random.key(7), len(MEAN))
    draws = {
        name: MEAN[name] + SIGMA[name] * jax.random.normal(key, (count,))
        for name, key in zip(MEAN, keys, strict=True)
    }
    return np.asarray(jax.jit(jax.vmap(function))(draws))


def test_an_equilibrium_spreads_as_a_thousand_runs_do():
    found = design.propagate_covariance(finger, MEAN, deviation=SIGMA)
    seen = runs(finger)
    assert abs(found.deviation / seen.std(ddof=1) - 1) < 0.1
    assert abs(found.mean - seen.mean()) < 0.1 * seen.std(ddof=1)
    assert np.isclose(sum(found.shares.values()), 1.0)


def test_at_an_optimum_the_second_order_is_what_spreads():
    """The square error of the height, least at the mean."""
    goal = finger(MEAN)

    def missed(p):
        return ((finger(p) - goal) / mm) ** 2

    first = design.propagate_covariance(missed, MEAN, deviation=SIGMA)
    second = design.propagate_covariance(missed, MEAN, deviation=SIGMA, order=2)
    seen = runs(missed)
    assert abs(first.deviation) < 1e-6 * seen.std(ddof=1)
    assert abs(second.deviation / seen.std(ddof=1) - 1) < 0.1
    assert abs(second.mean / seen.mean() - 1) < 0.1


def test_the_covariance_of_a_fit_is_the_scatter_of_fits():
    """Of 400 noisy tests, and of the linear model in closed form."""
    strain = np.linspace(0.05, 2.0, 40)
    stretch = 1 + strain
    column = stretch - stretch**-2
    noise = np.random.default_rng(0).normal(size=(400, 40)) * 1e3
    fits = [
        material.fit_tensile(strain, 1e5 * column + row, model=material.NeoHookean)
        for row in noise[:1]
    ]
    error = np.asarray(noise[0] - column * (column @ noise[0]) / (column @ column))
    wanted = error @ error / 39 / (column @ column)
    assert np.isclose(fits[0].covariance[0, 0], wanted, rtol=1e-9)
    # A nonlinear one: deviations of the fitted constants over those that each fit tells.
    clean = column / (1 - (stretch**2 + 2 / stretch - 3) / 12.0) * 1e5
    gents = [
        material.fit_tensile(strain, clean + row, model=material.Gent) for row in noise[:60]
    ]
    found = np.array([[f.material.shear_modulus, f.material.locking] for f in gents])
    told = np.sqrt(np.mean([np.diag(f.covariance) for f in gents], axis=0))
    assert np.allclose(found.std(axis=0, ddof=1) / told, 1.0, atol=0.25)
    exact = material.fit_tensile(strain[:1], 1e5 * column[:1], model=material.NeoHookean)
    assert np.isnan(exact.covariance).all()


def test_a_fit_and_what_follows_from_it():
    """Constants of a fit with their covariance, to the stress at a stretch of two."""
    strain = np.linspace(0.05, 2.0, 30)
    stress = 1e5 * (1 + strain - (1 + strain) ** -2)
    stress = stress + 1e3 * np.random.default_rng(1).normal(size=30)
    fit = material.fit_tensile(strain, stress, model=material.MooneyRivlin, stable=False)
    constants = jnp.stack([fit.material.c10, fit.material.c01])
    row = np.array([2.0, 2 / 2.0]) * (2 - 0.25)
    found = design.propagate_covariance(
        lambda c: jnp.asarray(row) @ c, constants, covariance=fit.covariance
    )
    assert np.isclose(found.deviation, np.sqrt(row @ fit.covariance @ row))
    assert 50 < found.deviation < 1e3


@pytest.mark.parametrize(
    "options, message",
    [
        ({}, "neither of `covariance`"),
        ({"covariance": np.eye(2), "deviation": jnp.ones(2)}, "both of `covariance`"),
        ({"covariance": np.eye(3)}, "covariance"),
        ({"covariance": np.array([[1.0, 2.0], [2.0, 1.0]])}, "indefinite"),
        ({"covariance": np.array([[1.0, 0.5], [0.0, 1.0]])}, "not symmetric"),
        ({"covariance": np.full((2, 2), np.nan)}, "must be finite"),
        ({"deviation": jnp.ones(3)}, "one standard deviation for each"),
        ({"deviation": -jnp.ones(2)}, "need 0 or more"),
        ({"deviation": jnp.ones(2), "order": 3}, "need 1 or 2"),
    ],
)
def test_wrong_uncertainties_name_the_remedy(options, message):
    with pytest.raises(ValueError, match=message):
        design.propagate_covariance(jnp.sum, jnp.ones(2), **options)
    with pytest.raises(ValueError, match="need one number"):
        design.propagate_covariance(lambda x: x, jnp.ones(2), deviation=jnp.ones(2))
