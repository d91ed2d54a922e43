"""A rod on the face of a solid: in balance with it, and each as if it were alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import coupling, fem, material, mesh, rod, systems
from sorojax.math.lie import SE2, SE3
from sorojax.units import mm

RUBBER = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3, density=1000)
BAR = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1), order=2)
HELD = (fem.Fixed(BAR.node_sets["left"]),)
BASE = np.array([[1, 0, 40 * mm], [0, 1, 5 * mm], [0, 0, 1]])
ELASTIC = rod.elastic(material.neo_hookean(young_modulus=4e5, poisson_ratio=0.45, density=1000))
WHISKER = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(2 * mm), ELASTIC, length=50 * mm)
PULL = np.array([2e-3, 1e-2])
SHARP = fem.Newton(residual_tolerance=1e-12, step_tolerance=1e-10)


def mounted(**options):
    cells, whisker = coupling.mounted_rod(BAR, WHISKER, BAR.node_sets["right"], BASE, **options)
    return fem.problem(
        cells, RUBBER, kinematics=fem.PlaneStrain(10 * mm), supports=HELD, loads=(whisker,)
    )


@pytest.mark.versions
def test_rod_and_solid_are_each_in_equilibrium_with_the_wrench_between_them():
    gravity = [0.0, -2.0]
    problem = mounted(value=PULL, gravity=gravity)
    u = fem.solve(problem, newton=SHARP).displacement
    found = coupling.mount_wrench(problem, u)
    turn = found.base[:2, :2]
    assert float(jnp.arctan2(turn[1, 0], turn[0, 0])) > 0.05
    # the force at the tip and the weight reach the solid whole
    mass = 1000 * np.pi * (2 * mm) ** 2 * 50 * mm
    np.testing.assert_allclose(found.force, PULL + mass * np.array(gravity), rtol=1e-12)
    # the rod alone, in the axes of its base
    forces = (
        rod.TipWrench(jnp.append(0.0, turn.T @ jnp.asarray(PULL))),
        rod.Gravity(turn.T @ jnp.asarray(gravity)),
    )  # fmt: skip
    alone = rod.equilibrium(WHISKER, forces=forces)
    np.testing.assert_allclose(found.coordinates, alone.q, rtol=1e-6, atol=1e-8)
    # the solid alone, under that wrench
    right = BAR.node_sets["right"]
    loads = (
        fem.Force(right, found.force), fem.Torque(right, found.moment[0], name="turn"),
    )  # fmt: skip
    plane = fem.PlaneStrain(10 * mm)
    bare = fem.problem(BAR, RUBBER, kinematics=plane, supports=HELD, loads=loads)
    solid = fem.solve(bare, newton=SHARP).displacement
    np.testing.assert_allclose(u[: BAR.num_nodes], solid, rtol=0, atol=1e-9)


def test_slopes_by_force_rod_and_solid_are_those_of_the_values():
    def tip(numbers):
        pull, young, thick = numbers
        whisker = rod.rod(
            SE2(), rod.chebyshev(kappa_z=2), rod.circle(2 * mm), length=50 * mm,
            young_modulus=young, poisson_ratio=0.45, density=1000,
        )  # fmt: skip
        cells, load = coupling.mounted_rod(
            BAR, whisker, BAR.node_sets["right"], BASE, value=pull * PULL
        )
        plane = fem.PlaneStrain(thick)
        problem = fem.problem(cells, RUBBER, kinematics=plane, supports=HELD, loads=(load,))
        u = fem.solve(problem, newton=SHARP).displacement
        return coupling.mount_wrench(problem, u).tip[1, 2]

    at = jnp.array([1.0, 4e5, 10 * mm])
    slope = jax.grad(tip)(at)
    for k, size in enumerate(np.asarray(at)):
        step = 1e-4 * size * np.eye(3)[k]
        ahead, behind = (float(tip(at + s * step)) for s in (1, -1))
        assert float(slope[k]) == pytest.approx((ahead - behind) / (2e-4 * size), rel=1e-6)


def test_in_space_a_rigid_motion_carries_the_rod_along():
    block = mesh.box([0, 0, 0], [20 * mm, 10 * mm, 10 * mm], divisions=(2, 2, 2))
    spatial = rod.rod(
        SE3(), rod.chebyshev(kappa_y=2, kappa_z=2), rod.circle(2 * mm), ELASTIC, length=50 * mm
    )
    base = np.eye(4)
    base[:3, 3] = 20 * mm, 5 * mm, 5 * mm
    cells, load = coupling.mounted_rod(block, spatial, block.node_sets["right"], base)
    held = (fem.Fixed(block.node_sets["left"]),)
    problem = fem.problem(cells, RUBBER, supports=held, loads=(load,))
    axis = jnp.array([1.0, -2.0, 0.5])
    rest = cells.points[load.places]
    u = fem.rotated(cells.points, 2.1, [0.01, 0.02, 0.0], axis).at[load.places].set(0 * rest)
    force = jax.grad(lambda u: load.potential(problem, u))(u)
    assert jnp.max(jnp.abs(force)) < 1e-13
    found = coupling.mount_wrench(problem, u)
    turned = fem.rotated(jnp.eye(3), 2.1, [0.0, 0.0, 0.0], axis) + jnp.eye(3)
    np.testing.assert_allclose(found.base[:3, :3], turned.T, atol=1e-12)
    end = jnp.asarray([[70 * mm, 5 * mm, 5 * mm]])
    moved = end + fem.rotated(end, 2.1, [0.01, 0.02, 0.0], axis)
    np.testing.assert_allclose(found.tip[:3, 3], moved[0], atol=1e-12)


def test_wrong_mounts_say_what_to_do():
    with pytest.raises(ValueError, match=r"has no direction"):
        coupling.mounted_rod(BAR, WHISKER, BAR.node_sets["right"][:1], BASE)
    with pytest.raises(ValueError, match=r"need one space"):
        coupling.mounted_rod(BAR, WHISKER, BAR.node_sets["right"], np.eye(4))
    problem = mounted(value=PULL)
    with pytest.raises(ValueError, match=r"need one of \['rod'\]"):
        coupling.mount_wrench(problem, jnp.zeros_like(problem.mesh.points), "other")
    with pytest.raises(ValueError, match=r"modal_basis: got masses"):
        systems.modal_basis(systems.FemBody(problem), 1)
