"""Strain bases, breaks, rest strain and taper: exact products, partition, orthonormality."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.lie import SE2, SE3
from sorojax.math.quadrature import (
    Quadrature,
    gauss_legendre,
    integration_matrix,
    integration_rows,
    interpolation_rows,
)
from sorojax.rod.model.basis import Combined, SampledModes

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DISC = R.circle(6e-3)
RULE = Quadrature(6, (0.2, 0.7))


class Wave(eqx.Module):
    """One mode with a number of its own."""

    rate: jax.Array

    def __call__(self, s):
        return jnp.sin(self.rate * jnp.asarray(s))[:, None]


BASES = {
    "chebyshev": R.chebyshev(kappa_z=4),
    "legendre": R.legendre(kappa_z=4),
    "bernstein": R.bernstein(kappa_z=4),
    "fourier": R.fourier(kappa_z=5),
    "constant": R.piecewise_constant(kappa_z=3),
    "linear": R.piecewise_linear(kappa_z=4),
    "pieces": R.piecewise(R.legendre(kappa_z=2), [0.3]),
    "cubic": R.bspline(kappa_z=6),
    "knots": R.bspline(kappa_z=6, degree=2, knots=[0.2, 0.2, 0.6]),
    "functions": R.functions(kappa_z=[lambda s: 1 + s, lambda s: 1 / (1 + s)]),
    "module": R.functions(kappa_z=Wave(jnp.array(3.0))),
    "sampled": R.StrainBasis(
        {
            "kappa_z": SampledModes(
                np.linspace(0, 1, 11), np.linspace(0, 1, 11)[:, None] ** [1, 3]
            )
        }
    ),
}


def kinks(modes):
    return SampledModes(modes.s, modes.values).s[1:-1] if hasattr(modes, "s") else modes.breaks


@pytest.mark.parametrize("name", BASES)
def test_host_and_device_values_agree_and_orthonormal_modes_span_the_same(name):
    modes = BASES[name].modes["kappa_z"]
    s = np.array([0.0, 0.11, 0.2, 0.3, 0.5, 2 / 3, 0.95, 1.0])
    assert np.allclose(modes(s), jax.jit(lambda s: modes(s))(s), rtol=0, atol=1e-13)
    nodes, weights = gauss_legendre(Quadrature(40, tuple(float(k) for k in kinks(modes))))
    own = R.orthonormalise(BASES[name]).modes["kappa_z"]
    found, given = np.asarray(own(nodes)), np.asarray(modes(nodes))
    gram = (weights[:, None] * found).T @ found
    assert np.allclose(gram, np.eye(modes.count), rtol=0, atol=1e-13)
    rest = given - found @ (found.T @ (weights[:, None] * given))
    assert np.abs(rest).max() < 1e-12


@pytest.mark.parametrize("name", ["bernstein", "constant", "linear", "cubic", "knots"])
def test_local_modes_are_positive_and_sum_to_one(name):
    values = BASES[name].modes["kappa_z"](np.linspace(0, 1, 41))
    assert np.all(values > -1e-15)
    assert np.allclose(values.sum(axis=1), 1.0, rtol=0, atol=1e-14)


def test_cubic_splines_are_those_of_scipy():
    from scipy.interpolate import BSpline

    s, p = np.linspace(0, 1, 30, endpoint=False), 3
    knots = np.array([0, 0, 0, 0, 0.25, 0.5, 0.5, 1, 1, 1, 1])
    modes = R.BSpline((0.25, 0.5, 0.5), p)
    assert np.allclose(
        modes(s), BSpline.design_matrix(s, knots, p).toarray(), rtol=0, atol=1e-15
    )


def test_a_composite_rule_integrates_and_interpolates_across_its_breaks():
    nodes, weights = gauss_legendre(RULE)
    rough = np.where(nodes < 0.2, nodes**5, np.where(nodes < 0.7, 2 - nodes, 7 * nodes**3))
    s = np.array([0.0, 0.13, 0.2, 0.5, 0.7, 0.9, 1.0])
    first, second = 0.2**6 / 6, 2 * (s - 0.2) - (s**2 - 0.04) / 2
    until = 0.2**6 / 6 + 2 * 0.5 - (0.49 - 0.04) / 2
    exact = np.select(
        [s <= 0.2, s <= 0.7], [s**6 / 6, first + second], until + 7 / 4 * (s**4 - 0.7**4)
    )
    assert np.allclose(integration_rows(RULE, s) @ rough, exact, rtol=0, atol=1e-15)
    on_device = jax.jit(lambda s: integration_rows(RULE, s) @ rough)(s)
    assert np.allclose(on_device, exact, rtol=0, atol=1e-15)
    assert np.isclose(weights @ rough, exact[-1], rtol=1e-14)
    assert np.allclose(integration_matrix(RULE)[-1] @ rough, exact[-1], rtol=0.5)
    values = np.where(s < 0.2, s**5, np.where(s < 0.7, 2 - s, 7 * s**3))
    assert np.allclose(interpolation_rows(RULE, s) @ rough, values, rtol=0, atol=1e-13)
    assert np.allclose(interpolation_rows(8, s) @ gauss_legendre(8)[0] ** 7, s**7, atol=1e-14)
    assert np.array_equal(integration_matrix(Quadrature(8)), integration_matrix(8))


STRAINS = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")


def test_piecewise_constant_strains_give_products_of_exponentials():
    counts = dict.fromkeys(STRAINS, 3)
    rod = R.rod(SE3(), R.piecewise_constant(**counts), DISC, nodes=36, **FINGER)
    rng = np.random.default_rng(0)
    scale = np.array([15.0] * 3 + [0.2] * 3)
    strains = rng.normal(size=(6, 3)) * scale[:, None]
    poses = R.forward_kinematics(rod, strains.reshape(-1), [1 / 3, 0.5, 2 / 3, 1.0])
    third = 0.08 / 3 * (np.array([[0, 0, 0, 1.0, 0, 0]]) + strains.T)
    twists = np.concatenate([third, third[1:2] / 2])
    *steps, half = np.asarray(jax.jit(jax.vmap(SE3().exp))(twists))
    exact = [steps[0], steps[0] @ half, steps[0] @ steps[1], steps[0] @ steps[1] @ steps[2]]
    gap = np.abs(poses - np.stack(exact))
    assert gap[:, :3, :3].max() < 1e-12 and gap[:, :3, 3].max() < 1e-12 * 0.08
    flat = R.rod(SE2(), R.piecewise_constant(kappa_z=3), DISC, nodes=36, **FINGER)
    tip = R.tip_pose(flat, strains[2])
    twists = 0.08 / 3 * np.stack([strains[2], np.ones(3), np.zeros(3)], axis=1)
    turns = np.asarray(jax.jit(jax.vmap(SE2().exp))(twists))
    assert np.abs(tip - turns[0] @ turns[1] @ turns[2]).max() < 1e-13


def test_a_piecewise_basis_that_repeats_the_smooth_one_gives_the_same_dynamics():
    rng = np.random.default_rng(1)
    q, v = rng.normal(size=4) * 5, rng.normal(size=4) * 20
    smooth = R.rod(SE3(), R.legendre(kappa_y=2, kappa_z=2), DISC, nodes=12, **FINGER)
    parts = R.piecewise(R.legendre(kappa_y=2, kappa_z=2), 2)
    split = R.rod(SE3(), parts, DISC, nodes=16, **FINGER)

    @jax.jit
    def terms(rod, q, v):
        return R.bias_force(rod, q, v), R.stiffness_matrix(rod)

    # 2 s - 1 on a half is -1/2 or 1/2 plus half the local coordinate.
    one = np.array([[1, -0.5], [0, 0.5], [1, 0.5], [0, 0.5]])
    up = np.kron(np.eye(2), one)
    found, stiff = map(np.asarray, terms(split, up @ q, up @ v))
    expected, soft = map(np.asarray, terms(smooth, q, v))
    assert np.allclose(up.T @ found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert np.allclose(up.T @ stiff @ up, soft)


def test_a_bent_rest_shape_is_an_offset_of_the_coordinates():
    basis, q = R.legendre(kappa_y=2, kappa_z=2, sigma_x=1), np.array([4.0, -3, 8, 5, 0.02])

    def bent(s):
        x = 2 * s - 1
        return np.stack([0 * s, 10 + 20 * x, 15 - 5 * x, 1.1 + 0 * s, 0 * s, 0 * s], axis=1)

    shift = np.array([10.0, 20.0, 15.0, -5.0, 0.1])
    rod = R.rod(SE3(), basis, DISC, rest_strain=bent, nodes=12, **FINGER)
    plain = R.rod(SE3(), basis, DISC, nodes=12, **FINGER)
    s = np.array([0.1, 0.6, 1.0])

    @jax.jit
    def terms(rod, q, v):
        shape = R.forward_kinematics(rod, q, s), R.strain(rod, q, s)
        return *shape, R.bias_force(rod, q, v), R.elastic_force(rod, v)

    found, expected = terms(rod, q, q), terms(plain, q + shift, q)
    assert np.allclose(found[0], expected[0], rtol=0, atol=1e-13)
    assert np.allclose(found[1], expected[1], rtol=0, atol=1e-12)
    assert np.allclose(found[2], expected[2], rtol=1e-9, atol=1e-12)
    assert np.allclose(found[3], expected[3])


def test_a_rest_curvature_may_jump_and_lies_in_the_plane_too():
    def hook(s):
        return np.stack([np.where(s < 0.5, 0.0, 40.0), 1 + 0 * s, 0 * s], axis=1)

    rod = R.rod(
        SE2(), R.constant("kappa_z"), DISC, rest_strain=hook, breaks=[0.5], nodes=24, **FINGER
    )
    tip = jax.jit(lambda q: (R.tip_pose(rod, q), R.tip_angle(R.motion(rod, q))))
    angle, (x, turn) = 40 * 0.04, tip(np.zeros(1))
    exact = np.array([0.04 + np.sin(angle) / 40, (1 - np.cos(angle)) / 40])
    assert np.allclose(x[:2, 2], exact, rtol=0, atol=1e-14)
    assert np.isclose(turn, angle, rtol=1e-14)


def test_a_taper_does_not_depend_on_the_nodes():
    start, end = 6e-3, 3e-3

    def made(end, nodes):
        section = R.taper(R.circle, start, end)
        return R.rod(SE3(), R.constant("kappa_z"), section, nodes=nodes, **FINGER)

    @functools.partial(jax.jit, static_argnums=1)
    def rigid(end, nodes):
        constants = R.operators(made(end, nodes))
        return constants.stiffness[0, 0], constants.mass

    few, mass = rigid(end, 8)
    cone = np.pi * 0.08 / 3 * (start**2 + start * end + end**2) * 2000.0
    assert np.isclose(np.sum(mass), cone, rtol=1e-13)
    many = rigid(end, 16)[0]
    exact = np.pi / 4 * 1e6 * 0.08 * (start**5 - end**5) / (5 * (start - end))
    assert np.isclose(few, exact, rtol=1e-13) and np.isclose(many, exact, rtol=1e-13)
    slope = jax.jit(jax.grad(lambda end: rigid(end, 8)[0]))(end)
    ends = [rigid(end + h, 8)[0] for h in (1e-7, -1e-7)]
    assert np.isclose(slope, (ends[0] - ends[1]) / 2e-7, rtol=1e-8)


def test_smooth_modes_of_samples_keep_the_order_of_the_rotations():
    s = np.linspace(0, 1, 41)
    exact = R.chebyshev(kappa_y=3)
    sampled = R.StrainBasis({"kappa_y": SampledModes(s, exact(s)[0])})
    smooth = R.fitted(sampled, R.Legendre(8))
    rods = [R.rod(SE3(), b, DISC, nodes=16, **FINGER) for b in (exact, smooth)]
    every = jax.jit(lambda q: [R.forward_kinematics(r, q, [0.5, 1.0]) for r in rods])
    poses = every(np.array([20.0, 15.0, -10.0]))
    assert np.allclose(*poses, rtol=0, atol=1e-13)


def test_numbers_in_a_user_function_have_a_gradient():
    def height(rate):
        basis = R.functions(kappa_z=Wave(rate))
        rod = R.rod(SE2(), basis, DISC, nodes=12, **FINGER)
        return R.tip_pose(rod, jnp.array([20.0]))[1, 2]

    both = jax.jit(jax.value_and_grad(height))
    slope, ends = both(3.0)[1], [both(3.0 + h)[0] for h in (1e-5, -1e-5)]
    assert np.isclose(slope, (ends[0] - ends[1]) / 2e-5, rtol=1e-7)


def make(basis=None, **options):
    basis = R.chebyshev(kappa_z=3) if basis is None else basis
    return R.rod(SE2(), basis, options.pop("section", DISC), **FINGER, **options)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: R.chebyshev(kappa_w=3), r"got the strains \['kappa_w'\], need one or more"),
        (lambda: R.bernstein(kappa_z=0), "must be a number of modes, 1 or more, got 0"),
        (lambda: R.piecewise_constant(kappa_z=1.5), "got 1.5 for `kappa_z`, need a whole"),
        (lambda: R.StrainBasis({"kappa_z": 3}), "need a dict of AbstractModes"),
        (lambda: R.StrainBasis({}), "got the strains none"),
        (lambda: R.piecewise(R.constant("kappa_z"), [0.5, 0.5]), "rise strictly inside"),
        (lambda: R.piecewise(R.constant("kappa_z"), 0), "`segments` must be a number"),
        (lambda: R.piecewise_linear(kappa_z=1), "has 1 knot, need 2 or more"),
        (lambda: R.bspline(kappa_z=3), "need 4 or more"),
        (lambda: R.bspline(kappa_z=5, knots=[0.2, 0.4]), "2 inner knots, need 6"),
        (lambda: R.BSpline((0.5, 0.2)), "need numbers that rise inside"),
        (lambda: R.functions(kappa_z=lambda s: s), r"shape \(3,\), need \(3, 1\)"),
        (lambda: R.orthonormalise(R.functions(kappa_z=[np.sin, np.sin])), "depend on each"),
        (lambda: Combined(R.Legendre(2), np.zeros((3, 1))), r"need \(2, modes\)"),
        (lambda: make(R.chebyshev(kappa_z=9), nodes=6), "need 9 or more there to tell the 9"),
        (lambda: make(R.piecewise_constant(kappa_z=3), nodes=20), "need a multiple of 3"),
        (lambda: make(nodes=1), "need 3 or more"),
        (lambda: make(breaks=[1.5]), "the breaks are"),
        (
            lambda: make(section=R.circle(np.full(5, 1e-3))),
            r"has shape \(5,\), need one number",
        ),
        (lambda: make(rest_strain=lambda s: np.zeros((len(s), 2))), "`rest_strain` has shape"),
    ],
)
def test_bad_input_names_the_remedy(wrong, message):
    with pytest.raises((TypeError, ValueError), match=message):
        wrong()
