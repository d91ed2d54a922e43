"""Statics: the cases of the literature, load steps, limit points, derivatives, assemblies."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.cases import rod_statics as cases
from sorojax import replace, rod as R
from sorojax.math.lie import SE2
from sorojax.math.status import Status

equilibrium_module = sys.modules["sorojax.rod.statics.equilibrium"]
FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
BENDING = 1e6 * np.pi / 4 * 6e-3**4


def flat(modes=4):
    return R.rod(SE2(), R.chebyshev(kappa_z=modes), R.circle(6e-3), **FINGER)


@pytest.mark.parametrize(
    "name, modes",
    [
        ("elastica 1", 5),
        ("elastica 5", 7),
        ("elastica 10", 8),
        ("shearable finger", 8),
        ("roll-up", 3),
        ("45-degree bend", 6),
        ("Princeton beam", 4),
    ],
)
def test_the_cases_of_the_literature(name, modes):
    case, references, _, bar = cases.CASES[name]
    for key in list(references)[-1:]:
        (search, tip), scale = case(modes, key)
        rest = search()
        assert rest.status == Status.successful
        found = np.asarray(tip(rest.q)) / scale
        assert cases.error(name, found, np.array(references[key])) < bar


def test_every_member_of_a_batch_ends_as_it_does_alone():
    """Of many searches some come to where no step makes the residual any smaller."""

    def hanging(radius):
        rod = R.rod(SE2(), R.chebyshev(kappa_z=3), R.circle(radius), **FINGER)
        return R.equilibrium(rod, (R.Gravity(),))

    rest = jax.jit(jax.vmap(hanging))(jnp.linspace(2e-3, 6e-3, 500))
    assert jnp.all(rest.status == Status.successful)
    assert jnp.all(rest.iterations <= 7)


LOADS = jnp.linspace(0.5, 12.0, 4) * BENDING / 0.08**2


def test_load_steps_reach_what_each_load_holds():
    body = flat(5)
    path = R.equilibrium_path(body, dead, LOADS)
    assert jnp.all(path.status._value == Status.successful._value)
    alone = R.equilibrium(body, dead(LOADS[-1]), 0.9 * path.q[-1])
    assert jnp.allclose(path.q[-1], alone.q, rtol=1e-9, atol=1e-9)


def dead(factor):
    return (R.TipWrench(jnp.stack([0 * factor, 0 * factor, factor])),)


class Pin(R.AbstractForce):
    """A stiff spring that holds the tip where it is at rest."""

    place: jax.Array
    stiffness: jax.Array

    def __call__(self, t, motion):
        tip = R.points(motion, np.array([1.0]))
        return tip.generalised(self.stiffness * (self.place[None] - tip.position))


TURN = 1.2  # of the arch [rad]
ARCH = R.rod(
    SE2(),
    R.chebyshev(kappa_z=5),
    R.rectangle(1e-2, 1e-3),
    length=0.1,
    young_modulus=1e6,
    poisson_ratio=0.4,
    density=1e3,
    rest_strain=[-TURN / 0.1, 1.0, 0.0],
)


def press(factor):
    """Pins the far end, presses on the middle towards the chord."""
    ends = 0.1 / TURN * np.array([np.sin(TURN), np.cos(TURN) - 1])
    down = jnp.array([0.0, -np.sin(TURN / 2), -np.cos(TURN / 2)])
    return Pin(jnp.array(ends), jnp.array(1e2)), R.PointWrench(1e-2 * factor * down, 0.5)


@pytest.mark.stress(22)
def test_an_arch_snaps_through():
    path = R.arc_length_path(ARCH, press, first=0.1, steps=60, longest=1.5)
    assert jnp.all(path.status._value == Status.successful._value)
    rest = jax.jit(jax.vmap(lambda q, f: R.total_force(press(f), 0.0, R.motion(ARCH, q))))(
        path.q, path.factors
    )
    stiffness = R.stiffness_matrix(ARCH)
    assert jnp.abs(rest).max() < 1e-8 * jnp.abs(stiffness @ path.q[-1]).max()
    # It turns back at limit points, is unstable between, and stable on the other side.
    turns = jnp.diff(jnp.sign(jnp.diff(path.factors)))
    assert jnp.sum(turns < 0) >= 1 and jnp.sum(turns > 0) >= 1
    negative = path.negative_eigenvalues
    assert negative[0] == 0 and negative.max() >= 1 and negative[-1] == 0
    assert repr(path).startswith("Path: 60 states, successful")


def test_an_assembly_hangs_as_the_rod_it_is_made_of():
    half = R.rod(SE2(), R.chebyshev(kappa_z=3), R.circle(6e-3), **{**FINGER, "length": 0.04})
    whole = R.rod(SE2(), R.chebyshev(kappa_z=7), R.circle(6e-3), **FINGER)
    tip = R.tip_pose(whole, R.equilibrium(whole, (R.Gravity(),)).q)
    pair = R.serial(half, half)
    rest = R.equilibrium(pair, (R.Gravity(),))
    assert rest.status == Status.successful
    assert jnp.allclose(R.tip_pose(pair, rest.q)["segment_1"], tip, rtol=0, atol=1e-6)
    assert repr(rest).startswith("Solution: successful after ") and "iterations, q" in repr(
        rest
    )
    assert not hasattr(rest, "_repr_png_")  # a picture of it needs the model
    lost = R.equilibrium(whole, (R.Gravity([0.0, jnp.nan]),))
    assert lost.status == Status.not_finite


def test_the_path_is_differentiable_in_the_rod():
    def last(young):
        body = replace(flat(3), lambda r: r.material.young_modulus, young)
        return R.equilibrium_path(body, dead, LOADS).q[:, 0].sum()

    slope = jax.jit(jax.grad(last))(jnp.array(1e6))
    values = jax.jit(jax.vmap(last))(jnp.array([0.999e6, 1.001e6]))
    assert jnp.isclose(slope, (values[1] - values[0]) / 2e3, rtol=1e-5)


def test_the_determinant_waits_for_the_eigenvalues(monkeypatch):
    """Side by side they locked the threads of a CPU: 14 lanes of a rod with 38 coordinates
    under `jax.vmap` did not end on two cores (jaxlib 0.10.2)."""
    seen = []
    monkeypatch.setattr(jnp.linalg, "slogdet", lambda x: seen.append(x) or (1.0, 0.0))
    slope = jnp.array([[2.0, 1.0], [-1.0, 1.0]])
    for negative in (0, 1):
        equilibrium_module.is_unstable(slope, jnp.eye(2), jnp.array(negative))
    assert jnp.array_equal(seen[0], jnp.eye(2)) and jnp.array_equal(seen[1], slope)
