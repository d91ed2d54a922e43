"""Areas, volumes and moments of shapes whose numbers are traced, by `jit` and `vmap`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import sdf

PI = np.pi


def disc(r):
    return sdf.area(sdf.Circle([0.1, -0.2], r))


def rounded(p):
    """A plate whose four corners are round: width, height and radius."""
    half = p[:2] / 2 - p[2]
    return sdf.area(sdf.offset(sdf.Rectangle(-half, half), p[2]))


def blend(p):
    """A smooth union of two discs, blended over p[2]."""
    first, second = sdf.Circle([0.1, 0.0], p[0]), sdf.Circle([0.7, 0.3], p[1])
    return sdf.second_moments(sdf.SmoothUnion(first, second, p[2]))


def drilled(p):
    """A turned block with a hole: edges, so cells that halve."""
    half = jnp.stack([0.5 + 0 * p[0], 0.3 + 0 * p[0]])
    return sdf.area(sdf.rotate(sdf.Rectangle(-half, half), p[1]) - sdf.Circle([0, 0], p[0]))


def ball(r):
    return sdf.volume(sdf.Sphere([0.013, 0.027, -0.031], r), 16)


def brick(p):
    return sdf.volume(sdf.Box(-p / 2, p / 2), 8)


def torus(p):
    return sdf.inertia_tensor(sdf.Torus(p[0], p[1]), 2.0, 24)


def slopes(door, p):
    """Value, slope in reverse and in forward mode, all in one traced program."""
    eye = jnp.eye(p.size, dtype=p.dtype).reshape(p.size, *p.shape)

    def found(p):
        forward = jax.vmap(lambda way: jax.jvp(door, (p,), (way,))[1])(eye)
        return door(p), jax.jacrev(door)(p), jnp.moveaxis(forward, 0, -1)

    value, back, forth = jax.jit(found)(p)
    return value, np.asarray(back).reshape(forth.shape), np.asarray(forth)


@pytest.mark.parametrize(
    "door, p, value, slope, rtol, steep",
    [
        (disc, 0.7, PI * 0.49, [2 * PI * 0.7], 1e-8, 1e-8),
        (
            rounded,
            [1.0, 0.6, 0.1],
            0.6 - (4 - PI) * 0.01,
            [0.6, 1.0, -2 * (4 - PI) * 0.1],
            2e-7,
            1e-4,  # the curvature jumps where arcs begin: the number itself wavers there
        ),
        (ball, 0.4, 4 / 3 * PI * 0.064, [4 * PI * 0.16], 5e-5, 5e-5),
    ],
)
def test_they_have_closed_forms_and_derivatives_both_ways(door, p, value, slope, rtol, steep):
    found, back, forth = slopes(door, jnp.asarray(p))
    assert np.allclose(found, value, rtol=rtol)
    assert np.allclose(back, slope, rtol=steep)
    assert np.allclose(back, forth, rtol=1e-13)


def test_the_inertia_of_a_torus_has_a_closed_form():
    ring, tube = 0.8, 0.3
    p = jnp.array([ring, tube])
    value = jax.jit(torus)(p)
    mass = 2.0 * 2 * PI**2 * ring * tube**2
    polar, flat = mass * (ring**2 + 0.75 * tube**2), mass * (ring**2 / 2 + 0.625 * tube**2)
    diagonal = np.sort(np.diag(value))
    assert np.allclose(diagonal, [flat, flat, polar], rtol=5e-5)
    assert np.abs(value - np.diag(np.diag(value))).max() < 1e-4 * flat


@pytest.mark.parametrize(
    "door, p",
    [
        (rounded, (1.0, 0.6, 0.1)),
        (blend, (0.8, 0.6, 0.3)),
        (drilled, (0.2, 0.3)),
        (brick, (0.7, 0.5, 0.4)),
    ],
)
def test_value_and_slope_are_those_of_the_host_and_of_differences(door, p):
    p, h = jnp.array(p), 1e-6
    value, back, forth = slopes(door, p)
    assert np.allclose(value, door(p), rtol=1e-13, atol=1e-15)
    assert np.allclose(back, jax.jacrev(door)(p), rtol=1e-11, atol=1e-13)
    assert np.allclose(back, forth, rtol=1e-11, atol=1e-13)
    traced = jax.jit(door)
    ends = [[traced(p + k * h * way) for way in jnp.eye(len(p))] for k in (1, -1)]
    differences = np.moveaxis(np.subtract(*map(np.asarray, ends)), 0, -1) / (2 * h)
    assert np.allclose(back, differences, rtol=2e-6, atol=2e-6 * np.abs(differences).max())


@pytest.mark.parametrize("door", [disc, ball])
def test_eight_sizes_at_once_are_those_one_after_another(door):
    radii = jnp.linspace(0.2, 0.9, 8)
    values, rates = jax.vmap(jax.value_and_grad(door))(radii)
    one = jax.jit(jax.value_and_grad(door))
    singly = [one(r) for r in radii]
    assert np.allclose(values, [v for v, _ in singly], rtol=1e-14)
    assert np.allclose(rates, [g for _, g in singly], rtol=1e-13)


def test_what_cannot_be_counted_is_nan():
    def comb(r):
        return sdf.area(
            sdf.repeat(sdf.Circle([0, 0], 1.0), [3.0, 0], 20, separate=True) & box(r)
        )

    def box(r):
        return sdf.Rectangle(jnp.stack([-r, -r]), jnp.stack([r, r]))

    assert np.isfinite(jax.jit(comb)(30.0))
    few = jax.jit(lambda r: sdf.area(sdf.Circle([0, 0], r), most_cells=256))
    assert np.isnan(few(1.0))
    apart = jax.jit(lambda r: sdf.area(sdf.Circle([0, 0], r) & sdf.Circle([1.9, 0], r)))
    assert np.isnan(apart(0.9)) and apart(1.0) > 0
    open_ = jax.jit(lambda r: sdf.area(sdf.HalfPlane(jnp.stack([r, r]), [1.0, 0.0])))
    assert np.isnan(open_(1.0))


def test_the_counts_are_fixed_when_it_is_compiled():
    ball = sdf.Sphere([0, 0, 0], 1.0)
    with pytest.raises(ValueError, match="`resolution` is traced, need a whole number"):
        jax.jit(lambda n: sdf.volume(ball, n))(16)
    with pytest.raises(ValueError, match="`most_cells` is traced"):
        jax.jit(lambda n: sdf.area(sdf.Circle([0, 0], 1.0), most_cells=n))(999)
    with pytest.raises(ValueError, match="`most_cells` is 0, need 1 to"):
        sdf.area(sdf.Circle([0, 0], 1.0), most_cells=0)
