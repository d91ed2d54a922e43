"""Volume, inertia and their derivatives of solids with known answers."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import sdf
from sorojax.sdf.base import AbstractSdf, norm

RADIUS, TUBE = 0.7, 0.25


class Torus(AbstractSdf):
    """Ring about z [m]."""

    radius: jax.Array
    tube: jax.Array

    @property
    def dim(self):
        return 3

    def distance(self, x, y, z):
        return norm(norm(x, y) - self.radius, z) - self.tube

    def bounding_box(self):
        reach = self.radius + self.tube
        return jnp.stack([-reach, -reach, -self.tube]), jnp.stack([reach, reach, self.tube])


def ball(radius) -> AbstractSdf:
    return sdf.Sphere([0.013, 0.027, -0.031], radius)


def box(width) -> AbstractSdf:
    half = width / 2
    fixed = jnp.full_like(half, 0.5)
    upper = jnp.stack([half, fixed, 0.8 * fixed])
    return sdf.rotate(sdf.Box(-upper, upper), 0.6)


def relative(value, exact: float) -> float:
    return abs(float(value) / exact - 1)


def rows():
    jax.config.update("jax_enable_x64", True)
    one = jnp.asarray(1.0)
    exact = 4 / 3 * np.pi
    for cells in (32, 64, 128):
        timing = measure_calls(lambda cells=cells: sdf.volume(ball(one), cells), repeats=3)
        error = relative(sdf.volume(ball(one), cells), exact)
        yield _row("volume of a ball", cells, timing, error, 1e-7 if cells == 128 else None)
    slope = jax.grad(lambda r: sdf.volume(ball(r), 128))(one)
    yield _row("its slope in r", 128, None, relative(slope, 4 * np.pi), 1e-8)
    torus = Torus(jnp.asarray(RADIUS), jnp.asarray(TUBE))
    exact = 2 * np.pi**2 * RADIUS * TUBE**2
    timing = measure_calls(lambda: sdf.inertia_tensor(torus), repeats=3)
    yield _row("volume of a torus", 128, None, relative(sdf.volume(torus), exact), 1e-7)
    spin = relative(sdf.inertia_tensor(torus)[2, 2], exact * (RADIUS**2 + 0.75 * TUBE**2))
    yield _row("inertia of a torus", 128, timing, spin, 1e-7)
    wide = jnp.asarray(1.2)
    timing = measure_calls(lambda: sdf.volume(box(wide), 64), repeats=3)
    value, slope = jax.value_and_grad(lambda w: sdf.volume(box(w), 64))(wide)
    yield _row("volume of a turned box", 64, timing, relative(value, 0.96), 1e-3)
    yield _row("its slope in its width", 64, None, relative(slope, 0.8), 1e-3)


def _row(what, cells, timing, error, bar) -> Row:
    columns = timing.columns() if timing else {}
    return Row(
        "sorojax",
        {"method": what, "cells": cells},
        **columns,
        error=error,
        reference="exact",
        bar=bar,
        bar_on="error",
    )
