"""Rods in a solid whose mesh does not know them, against closed forms and resolved meshes."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh
from sorojax.units import mm

YOUNG, LENGTH, HEIGHT, DEPTH = 1e5, 100 * mm, 5 * mm, 10 * mm
RUBBER = material.neo_hookean(young_modulus=YOUNG, poisson_ratio=0.3, density=1000)
STRIP = mesh.rectangle([0, 0], [LENGTH, HEIGHT], divisions=(20, 2), element=mesh.Quad8())
MIDDLE = [[0, HEIGHT / 2], [LENGTH, HEIGHT / 2]]
SECOND_MOMENT = DEPTH * HEIGHT**3 / 12
BLOCK = mesh.box([0, 0, 0], [60 * mm, 10 * mm, 10 * mm], divisions=(6, 2, 2))
ALONG = np.linspace(0, 1, 60)[:, None]
TURN = np.concatenate([6 + 48 * ALONG, 5 + 3 * np.cos(6 * ALONG), 5 + 3 * np.sin(6 * ALONG)], 1)
HELIX = TURN * mm


def strip(*loads, cells=STRIP, supports=None, rubber=RUBBER):
    supports = supports or (fem.Fixed(cells.node_sets["left"]),)
    plane = fem.PlaneStress(DEPTH)
    return fem.problem(cells, rubber, kinematics=plane, supports=supports, loads=loads)


def in_block(*loads, cells=BLOCK):
    return fem.problem(
        cells, RUBBER, supports=(fem.Fixed(BLOCK.node_sets["left"]),), loads=loads
    )


def turned(points, vector=(0.7, -1.0, 2.0)):
    axis = jnp.asarray(vector) / np.linalg.norm(vector)
    return fem.rotated(points, 1.9, [0.01, 0.0, 0.02], axis) + jnp.array([[0.1, -0.2, 0.3]])


@pytest.mark.parametrize("bending", [None, 2e-5])
def test_a_rigid_motion_costs_nothing_and_forces_balance(bending):
    rod = fem.embedded_rod(
        BLOCK, HELIX, axial_stiffness=40.0, bending_stiffness=bending, clamped=(False, False)
    )
    problem = in_block(rod)
    force = jax.grad(lambda u: rod.potential(problem, u))
    assert jnp.max(jnp.abs(force(turned(BLOCK.points)))) < 1e-10
    waved = 1e-3 * jnp.sin(300 * BLOCK.points[:, ::-1])
    pull = force(waved)
    arms = BLOCK.points + waved
    assert jnp.max(jnp.abs(pull)) > 1e-2
    np.testing.assert_allclose(jnp.sum(pull, axis=0), 0, atol=1e-14)
    np.testing.assert_allclose(jnp.sum(jnp.cross(arms, pull), axis=0), 0, atol=1e-15)
    moved = fem.rod_forces(problem, waved)
    np.testing.assert_allclose(jnp.sum(moved.on_solid, axis=(0, 1)), 0, atol=1e-14)


def beam_drop(bending, load):
    """A Timoshenko beam with a rod in its middle that does not shear, both clamped."""
    own, shear = YOUNG * SECOND_MOMENT, YOUNG / 2.6 * 5 / 6 * HEIGHT * DEPTH
    whole = own + bending
    decay = np.sqrt(shear * (1 / own + 1 / bending))
    slope = load / (shear * (1 + bending / own))
    slid = slope * (LENGTH - np.tanh(decay * LENGTH) / decay)
    return load * LENGTH**3 / (3 * whole) + own / whole * slid


def test_a_backbone_stiffens_a_cantilever_as_the_composite_section_says():
    bending = 2 * YOUNG * SECOND_MOMENT
    rod = fem.embedded_rod(
        STRIP, MIDDLE, axial_stiffness=20.0, bending_stiffness=bending, clamped=(True, False)
    )
    tip = fem.Traction(STRIP.facet_sets["right"], [0, -1e-4 / (HEIGHT * DEPTH)])
    problem = strip(rod, tip)
    u = fem.solve(problem).displacement
    node = mesh.nearest_node(STRIP, MIDDLE[1])
    assert -float(u[node, 1]) == pytest.approx(beam_drop(bending, 1e-4), rel=4e-3)
    # two thirds of the moment, away from the ends
    found = fem.rod_forces(problem, u)
    at = found.positions[0, :-1, 0]
    inner = slice(4, -4)
    np.testing.assert_allclose(
        -found.moment[0, inner, 0], 2 / 3 * 1e-4 * (LENGTH - at[inner]), rtol=2e-2
    )
    assert float(jnp.max(jnp.abs(found.tension))) < 1e-4


def test_a_fibre_off_the_middle_bends_what_it_shortens():
    """Curvature EA e a / (EI + EA e^2 / (1 + EA / EA')) of a strip with a fibre at e."""
    off, axial, short = 1.5 * mm, 2.0, 1e-3
    line = [[0, HEIGHT / 2 + off], [LENGTH, HEIGHT / 2 + off]]
    fibre = fem.embedded_rod(STRIP, line, axial_stiffness=axial, value=short)
    u = fem.solve(strip(fibre)).displacement
    own, inertia = YOUNG * HEIGHT * DEPTH, YOUNG * SECOND_MOMENT
    both = axial * own / (axial + own)
    curvature = both * off * short / (inertia + both * off**2)
    rise = [float(u[mesh.nearest_node(STRIP, [x, HEIGHT / 2]), 1]) for x in (20 * mm, 80 * mm)]
    middle = float(u[mesh.nearest_node(STRIP, [50 * mm, HEIGHT / 2]), 1])
    bent = (rise[0] + rise[1] - 2 * middle) / (30 * mm) ** 2
    assert bent == pytest.approx(curvature, rel=5e-3)


def test_a_slack_fibre_carries_no_compression():
    right = STRIP.node_sets["right"]
    press = fem.Prescribed(right, [-1 * mm, 0.0])
    forces = []
    for slack in (False, True):
        fibre = fem.embedded_rod(STRIP, MIDDLE, axial_stiffness=20.0, tension_only=slack)
        problem = strip(fibre, supports=(fem.Fixed(STRIP.node_sets["left"]), press))
        u = fem.solve(problem).displacement
        forces.append(fem.rod_forces(problem, u).tension)
    np.testing.assert_allclose(forces[0], -0.2, rtol=2e-2)
    assert jnp.all(forces[1] == 0)


def wavy(y, x, height):
    """Lines that bend up in the middle of the strip; its sides stay."""
    return (
        y + 0.12 * height * np.sin(np.pi * x / LENGTH) ** 2 * 4 * y * (height - y) / height**2
    )


def test_a_wavy_fibre_is_that_of_a_mesh_that_follows_it():
    """In the plane: a band of 1/20 of the height, 40 times as stiff, under tension."""
    height, ratio = 20 * mm, 40.0
    half = height / 40
    rows = [0, height / 4, height / 2 - half, height / 2 + half, 3 * height / 4, height]
    heights = np.unique(np.concatenate([np.linspace(a, b, 3) for a, b in pairwise(rows)]))
    even = mesh.rectangle([0, 0], [LENGTH, 1.0], divisions=(50, 10), element=mesh.Quad8())
    x, share = np.asarray(even.points).T
    y = np.interp(share, np.linspace(0, 1, len(heights)), heights)
    cells = eqx.tree_at(
        lambda m: m.points, even, jnp.asarray(np.stack([x, wavy(y, x, height)], axis=1))
    )
    middles = np.stack([x, y], axis=1)[np.asarray(even.cells)[:, :4]].mean(axis=1)
    inside = np.abs(middles[:, 1] - height / 2) < half
    young = np.where(inside, ratio * YOUNG, YOUNG)
    band = material.NeoHookean(young / 2.6, young / 1.2)

    coarse = mesh.rectangle([0, 0], [LENGTH, height], divisions=(16, 2), element=mesh.Quad8())
    at = np.linspace(0, LENGTH, 101)
    line = np.stack([at, wavy(height / 2 + 0 * at, at, height)], axis=1)
    stiff = (ratio - 1) * YOUNG * 2 * half * DEPTH
    rod = fem.embedded_rod(
        coarse, line, axial_stiffness=stiff, bending_stiffness=stiff * (2 * half) ** 2 / 12,
        clamped=(True, True),
    )  # fmt: skip
    energies, unknowns = [], []
    for grid, rubber, loads in ((cells, band, ()), (coarse, RUBBER, (rod,))):
        ends = grid.node_sets["left"], grid.node_sets["right"]
        pull = fem.Prescribed(ends[1], [1 * mm, 0.0])
        problem = strip(*loads, cells=grid, rubber=rubber, supports=(fem.Fixed(ends[0]), pull))
        energies.append(float(fem.potential_energy(problem, fem.solve(problem).displacement)))
        unknowns.append(problem.space.num_dofs)
    bare = strip(cells=coarse, supports=(fem.Fixed(coarse.node_sets["left"]), pull_of(coarse)))
    without = float(fem.potential_energy(bare, fem.solve(bare).displacement))
    assert energies[1] == pytest.approx(energies[0], rel=5e-3)
    assert energies[0] > 1.5 * without
    assert unknowns[0] >= 10 * unknowns[1]


def pull_of(cells):
    return fem.Prescribed(cells.node_sets["right"], [1 * mm, 0.0])
