"""Derivatives of areas, volumes, centroids and inertia against differences of the same door."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import sdf


def box(p):
    """A box turned about z, its width and angle."""
    half = jnp.stack([p[0] / 2, 0.25 + 0 * p[0], 0.2 + 0 * p[0]])
    return sdf.rotate(sdf.Box(-half, half), p[1])


def notched(p):
    """A bar with two notches, narrower than a cell at 8 cells along it."""
    x = jnp.array([0.3, 0.7])
    low = jnp.stack([x - p[0] / 2, jnp.full(2, p[1]), jnp.full(2, -0.1)], axis=1)
    high = jnp.stack([x + p[0] / 2, jnp.full(2, 0.5), jnp.full(2, 0.5)], axis=1)
    bar = sdf.Box([0.0, 0.0, 0.0], [1.0, 0.4, 0.3])
    return bar - sdf.Box(low[0], high[0]) - sdf.Box(low[1], high[1])


def lens(p):
    return sdf.Sphere([0.0, 0.0, 0.1], p[0]) & sdf.Sphere([0.0, 0.0, -0.2], p[1])


def ball(p):
    return sdf.Sphere(jnp.stack([p[1], 0.02 + 0 * p[1], 0.01 + 0 * p[1]]), p[0])


def plate(p):
    """A square with a round hole and a slit 1/5000 of its width."""
    slit = sdf.Rectangle(
        jnp.stack([0.6 - p[1] / 2, 0.7 + 0 * p[1]]), jnp.stack([0.6 + p[1] / 2, 2 + 0 * p[1]])
    )
    return sdf.Rectangle([0.0, 0.0], [1.0, 1.0]) - sdf.Circle([0.35, 0.4], p[0]) - slit


def tilted(p):
    return sdf.rotate(
        sdf.Rectangle(jnp.stack([-p[0], -0.3 + 0 * p[0]]), jnp.stack([p[0], 0.4 + 0 * p[0]])),
        p[1],
    )


def volume(shape):
    return sdf.volume(shape, 16)


def inertia(shape):
    return sdf.inertia_tensor(shape, 1.0, 16)


CASES = {
    "box": (box, (0.7, 0.4), volume),
    "notches": (notched, (0.02, 0.13), lambda shape: sdf.inertia_tensor(shape, 1.0, 8)),
    "lens": (lens, (0.5, 0.6), volume),
    "ball": (ball, (0.4, 0.03), inertia),
    "plate": (plate, (0.2, 2e-4), sdf.area),
    "tilted": (tilted, (0.5, 0.3), sdf.second_moments),
}


@pytest.mark.filterwarnings("ignore:.*details too fine")
@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_the_number_itself(name):
    make, parameters, door = CASES[name]
    make = eqx.filter_jit(make)
    p, way = jnp.array(parameters), jnp.array([1.0, -0.7]) * jnp.array(parameters)
    value, slope = (np.asarray(a) for a in jax.jvp(lambda q: door(make(q)), (p,), (way,)))
    step = 1e-7  # differences of fields with edges have small kinks themselves
    ends = [np.asarray(door(make(p + e * step * way))) for e in (-1, 1)]
    difference = (ends[1] - ends[0]) / (2 * step)
    scale = np.maximum(np.abs(difference), 0.1 * np.abs(value).max())
    assert np.all(np.abs(slope - difference) < 1e-6 * scale), (slope, difference)


def test_faces_along_the_axes_move_the_volume_as_they_should():
    """Cells askew to a box: what its edges lose does not come and go with every cell."""
    sides = jnp.array([1.0, 0.9, 0.8])
    slope = jax.grad(lambda upper: sdf.volume(sdf.Box(jnp.zeros(3), upper), 16))(sides)
    assert np.allclose(slope, jnp.prod(sides) / sides, rtol=6e-4)


def test_narrow_slits_are_counted():
    """A slit of 1/300 of a cell: its area is seen, not lost between nodes."""
    p = jnp.array([0.2, 2e-5])
    exact = 1 - jnp.pi * 0.04 - 2e-5 * 0.3
    assert abs(float(sdf.area(plate(p)) / exact) - 1) < 1e-7


def test_details_too_fine_are_reported():
    foam = sdf.repeat(sdf.Sphere([0.0, 0.0, 0.0], 0.004), [0.05, 0.0, 0.0], 20)
    with pytest.warns(UserWarning, match="Raise `resolution`") as seen:
        sdf.volume(foam, 8)
    assert seen[0].filename == __file__  # the line of the user, not one of ours


class Nothing(sdf.AbstractSdf):
    """A field that is NaN beside its middle."""

    @property
    def dim(self):
        return 3

    def distance(self, x, y, z):
        return jnp.sqrt(x) - 0.5 + 0 * (y + z)

    def bounding_box(self):
        return -jnp.ones(3), jnp.ones(3)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: sdf.volume(sdf.Circle([0, 0], 1)), "volume: .* 2-D, need 3-D"),
        (lambda: sdf.area(sdf.Sphere([0, 0, 0], 1)), "area: .* 3-D, need 2-D"),
        (lambda: sdf.volume(sdf.Sphere([0, 0, 0], 1), 4), "need 8 to 1024"),
        (lambda: sdf.volume(sdf.Sphere([0, 0, 0], jnp.nan)), "got nan m. Give"),
        (lambda: sdf.volume(Nothing(), 16), "NaN at"),
        (
            lambda: sdf.volume(sdf.Sphere([0, 0, 0], 1) & sdf.Sphere([1.9, 1.2, 0], 1), 16),
            "empty",
        ),
    ],
)
def test_bad_shapes_name_the_remedy(make, message):
    with pytest.raises(ValueError, match=message):
        make()
