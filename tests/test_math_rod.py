"""Quadrature, rotations, small solves and steppers."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.compiled import batched, chunked_lanes
from sorojax.math.lie import (
    FROM_MOMENTS,
    SE2,
    SE3,
    exponential,
    multiply,
    prefix_product,
    rotation_columns,
    rotation_vector,
    skew,
)
from sorojax.math.linalg.dense import product, solve_columns, solve_symmetric
from sorojax.math.ode.explicit import DORMAND_PRINCE, RK4, explicit_step
from sorojax.math.quadrature import (
    gauss_legendre,
    integration_matrix,
    integration_rows,
)


@pytest.mark.parametrize("count", [2, 8, 48])
def test_spectral_integration_is_exact_on_polynomials(count):
    s, w = gauss_legendre(count)
    degree = count - 1
    integral = integration_matrix(count) @ s**degree
    assert np.allclose(integral, s ** (degree + 1) / (degree + 1), rtol=0, atol=1e-14)
    assert np.isclose(w.sum(), 1.0, rtol=0, atol=1e-14)
    tip = integration_rows(count, jnp.array([0.0, 1.0])) @ s**degree
    assert jnp.allclose(tip, jnp.array([0.0, 1 / count]), rtol=0, atol=1e-13)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-2, 1.0, 2.5])
def test_exponentials_agree_with_the_matrix_exponential(scale, getkey):
    drawn = jax.random.normal(getkey(), (6,))
    twist = scale * drawn / jnp.linalg.norm(drawn[:3])
    hat = jnp.zeros((4, 4)).at[:3, :3].set(skew(twist[:3])).at[:3, 3].set(twist[3:])
    motion = jax.scipy.linalg.expm(hat)
    assert jnp.allclose(SE3().exp(twist), motion, rtol=0, atol=1e-12)
    columns = rotation_columns(exponential(tuple(twist[:3])))
    rotation = jnp.stack([jnp.stack(c) for c in columns], axis=1)
    assert jnp.allclose(rotation, motion[:3, :3], rtol=0, atol=1e-12)


def test_planar_exponential_is_the_spatial_one_restricted():
    twist = jnp.array([0.7, 0.2, -0.4])
    spatial = SE3().exp(jnp.array([0.0, 0.0, 0.7, 0.2, -0.4, 0.0]))
    keep = jnp.array([0, 1, 3])
    restricted = spatial[keep][:, keep]
    assert jnp.allclose(SE2().exp(twist), restricted, rtol=0, atol=1e-14)


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_exponential_is_differentiable_at_the_identity(jacobian):
    assert jnp.isfinite(jax.jit(jacobian(SE3().exp))(jnp.zeros(6))).all()
    rate = jax.jit(jacobian(lambda x: jnp.stack(exponential(tuple(x)))))(jnp.zeros(3))
    half = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3) / 2])
    assert jnp.array_equal(rate, half)


@pytest.mark.versions
def test_magnus_is_of_order_six():
    def turn(cells):
        """Rotation of kappa = (1, s, s^2) over [0, 1] by `cells` cells."""
        edges = np.linspace(0, 1, cells + 1)
        x, w = gauss_legendre(4)
        s = edges[:-1, None] + x / cells
        kappa = [np.ones_like(s), 3 * s, 4 * s**2]
        weights = FROM_MOMENTS @ (w * (x - 0.5) ** np.arange(3)[:, None])
        coefficients = tuple(
            tuple(jnp.array((row * k).sum(1) / cells) for k in kappa) for row in weights
        )
        turns = prefix_product(exponential(rotation_vector(coefficients)))
        return jnp.stack([c[-1] for c in turns])

    exact = turn(64)
    coarse, fine = (float(jnp.abs(turn(n) - exact).max()) for n in (4, 8))
    assert 5.5 < np.log2(coarse / fine) < 6.8


def test_prefix_product_is_the_product_one_after_another(getkey):
    factors = exponential(tuple(jax.random.normal(getkey(), (3, 5))))
    found = jnp.stack(prefix_product(factors))
    product = tuple(c[0] for c in factors)
    for k in range(1, 5):
        product = multiply(product, tuple(c[k] for c in factors))
        assert jnp.allclose(found[:, k], jnp.stack(product), rtol=0, atol=1e-15)


@pytest.mark.parametrize("dof", [1, 6, 20])
def test_symmetric_solve(dof, getkey):
    root = jax.random.normal(getkey(), (dof, dof))
    matrix = root @ root.T + dof * jnp.eye(dof)
    right = jnp.ones(dof)
    assert jnp.allclose(matrix @ solve_symmetric(matrix, right), right, rtol=0, atol=1e-12)
    many = jnp.stack([right, jnp.arange(dof, dtype=right.dtype)], axis=1)
    assert jnp.allclose(matrix @ solve_columns(matrix, many), many, rtol=0, atol=1e-12)


@pytest.mark.parametrize("tableau, order", [(RK4, 4), (DORMAND_PRINCE, 5)])
def test_explicit_steps_have_their_order(tableau, order):
    def field(t, y):
        return y[1] * jnp.cos(t) * 0 + y[1], -y[0]

    def error(count):
        h, y = jnp.array(1.0 / count), (jnp.array(1.0), jnp.array(0.0))
        for k in range(count):
            y = explicit_step(tableau, field, k * h, y, h)
        return float(jnp.abs(y[0] - jnp.cos(1.0)))

    assert order - 0.5 < np.log2(error(4) / error(8)) < order + 1.2


@pytest.mark.parametrize("count", [3, 4, 11])
def test_chunks_give_what_the_whole_batch_gives(count):
    x = jnp.arange(3.0 * count).reshape(count, 3)
    items = {"x": x, "name": "kept"}

    def verb(item, shift):
        assert item["name"] == "kept"
        return jnp.sin(item["x"]).sum() + shift, item["x"] * shift

    def total(shift):
        first, second = batched(verb, chunk=4)(items, shift)
        return first @ second.sum(axis=1), first

    shift = jnp.linspace(0.0, 1.0, count)
    (_, first), slope = jax.jit(jax.value_and_grad(total, has_aux=True))(shift)
    sines = jnp.sin(x).sum(axis=1)
    assert jnp.allclose(first, sines + shift, rtol=1e-14)
    assert jnp.allclose(slope, x.sum(axis=1) * (sines + 2 * shift), rtol=1e-12)


def test_chunks_need_as_many_items_of_all():
    with pytest.raises(ValueError, match="first axes of"):
        batched(jnp.add)(jnp.zeros(3), jnp.zeros(4))
    with pytest.raises(ValueError, match="first axes of"):
        batched(jnp.add)(jnp.zeros(3), jnp.zeros(()))
    with pytest.raises(ValueError, match="`chunk` must be positive"):
        batched(jnp.add, chunk=0)


@pytest.mark.versions
@pytest.mark.parametrize("count", [5, 301])
def test_lanes_in_chunks_and_their_derivatives(count):
    """Where an argument is shared, a whole number, or no array."""

    def plain(item, shift, power, name):
        return jnp.sin(item["x"]).sum() * shift**power

    def total(verb, x, shift):
        return jax.vmap(lambda x: verb({"x": x}, shift, jnp.asarray(3), "two"))(x)

    def square(verb, x, shift):
        return jnp.sum(total(verb, x, shift) ** 2)

    x, shift = jnp.linspace(0.0, 1.0, 2 * count).reshape(count, 2), jnp.asarray([1.5, 2.5])
    verb = chunked_lanes(plain)
    loops = str(jax.make_jaxpr(lambda x: total(verb, x, shift[0]))(x)).count("scan")
    assert (loops > 0) == (count > 128)
    for change, of in (
        (jax.jit, total),
        (lambda f: jax.jacfwd(f, argnums=1), total),
        (lambda f: jax.jit(jax.grad(f, argnums=(0, 1))), square),
        (lambda f: jax.hessian(f, argnums=1), square),
    ):
        found, want = (change(functools.partial(of, v))(x, shift[0]) for v in (verb, plain))
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-13), found, want)
    twice = jax.vmap(functools.partial(total, verb), (None, 0))(x, shift)
    np.testing.assert_allclose(twice, [total(plain, x, each) for each in shift], rtol=1e-14)


@pytest.mark.versions
@pytest.mark.stress(92)
@pytest.mark.parametrize("change", [lambda f: f, jax.jit], ids=["plain", "jit"])
@pytest.mark.parametrize("lanes", [False, True])
def test_lanes_of_what_a_function_closes_over_have_their_derivative(change, lanes):
    """Of two results only one depends on it; there are as many lanes as numbers in each."""

    def pair(force, x):
        return force(x), jnp.outer(x, x)

    def total(verb, a, x):
        push, square = verb(lambda x: a * jnp.sin(x), x)
        return jnp.sum(jnp.cumsum(square @ push))

    def all_of(verb, a, x):
        one = functools.partial(total, verb)
        return jnp.sum(jax.vmap(jax.jit(one), (0, None))(a, x) ** 2) if lanes else one(a[0], x)

    a, x = jnp.asarray([0.5, -1.0, 2.0]), jnp.asarray([0.3, 0.7, 1.1])
    found, want = (
        change(jax.grad(functools.partial(all_of, verb), argnums=(0, 1)))(a, x)
        for verb in (chunked_lanes(pair), pair)
    )
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-13), found, want)


@pytest.mark.versions
@pytest.mark.stress(92)
@pytest.mark.parametrize(
    ("call", "shared", "own"),
    [
        (product, (8, 8), (8, 8, 8)),
        (product, (8, 8), (3, 8, 2)),
        (lambda a, b: product(b, a), (8, 2), (3, 8, 8)),
        (lambda a, b: solve_symmetric(a @ a.T + 4 * jnp.eye(4), b), (4, 4), (4, 4)),
        (lambda a, b: solve_symmetric(b @ b.T + 4 * jnp.eye(4), a), (4,), (3, 4, 4)),
        (lambda a, b: solve_symmetric(a @ a.T + 4 * jnp.eye(12), b), (12, 12), (12, 12)),
    ],
)
def test_derivatives_of_compiled_lanes_are_those_of_a_loop(call, shared, own):
    rng = np.random.default_rng(0)
    a, b, way = (jnp.asarray(rng.normal(size=shape)) for shape in (shared, own, shared))
    lanes, loop = (
        jax.jvp(all_of, (a,), (way,))[1]
        for all_of in (
            lambda a: jax.vmap(jax.jit(lambda b: jnp.sum(jnp.sin(a)) * call(a, b)))(b),
            lambda a: jnp.stack([jnp.sum(jnp.sin(a)) * call(a, x) for x in b]),
        )
    )
    assert jnp.allclose(lanes, loop, rtol=1e-12, atol=1e-12 * float(jnp.abs(loop).max()))


@pytest.mark.stress(92)
def test_a_mass_matrix_of_as_many_lanes_as_nodes_has_its_derivative():
    rod = R.rod(
        SE2(),
        R.chebyshev(kappa_z=2),
        R.circle(6e-3),
        length=0.08,
        nodes=8,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=2000.0,
    )
    states = jnp.asarray(np.random.default_rng(0).normal(size=(8, 2)))

    def total(length):
        model = replace(rod, length=length)
        return jnp.sum(jax.vmap(lambda q: R.mass_matrix(model, q))(states) ** 2)

    length, h = rod.length, 1e-4
    seen = (total(length + h) - total(length - h)) / (2 * h)
    assert jnp.isclose(jax.jit(jax.grad(total))(length), seen, rtol=1e-5)
