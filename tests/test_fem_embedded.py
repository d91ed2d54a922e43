"""Rods in a solid whose mesh does not know them, against closed forms and resolved meshes."""

import dataclasses
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh, systems
from sorojax.units import mm

YOUNG, LENGTH, HEIGHT, DEPTH = 1e5, 100 * mm, 5 * mm, 10 * mm
RUBBER = material.neo_hookean(young_modulus=YOUNG, poisson_ratio=0.3, density=1000)
STRIP = mesh.rectangle([0, 0], [LENGTH, HEIGHT], divisions=(20, 2), element=mesh.Quad8())
OFF = np.array([[0, 1 * mm]])
HIGH = [[10 * mm, HEIGHT / 4], [90 * mm, HEIGHT / 4]]
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


# ---- bond slip


def held_bar(**options):
    """A fibre in a strip that is held everywhere, and what pulls it out."""
    line = [[10 * mm, HEIGHT / 2], [90 * mm, HEIGHT / 2]]
    fibre = fem.embedded_rod(STRIP, line, axial_stiffness=5.0, spacing=1 * mm)
    options = {"bond_stiffness": 2e4, "tie_stiffness": 1e6} | options
    cells, rod = fem.bonded_rod(STRIP, fibre, bond_strength=2.0, **options)
    return cells, rod


def pulled(cells, rod, far):
    end = fem.Prescribed(rod.nodes[-1:], [far, 0.0], name="end")
    still = fem.Fixed(np.arange(STRIP.num_nodes))
    return fem.problem(
        cells, RUBBER, kinematics=fem.PlaneStress(DEPTH), supports=(still, end), loads=(rod,)
    )


def force_of(problem, u):
    return float(jnp.sum(fem.rod_forces(problem, u).on_solid[..., 0]))


def test_pull_out_follows_shear_lag_and_ends_at_the_strength_of_the_bond():
    """EA u'' = k u below the strength: P = EA b tanh(b L) u(L), b^2 = k / EA; then tau L."""
    cells, rod = held_bar()
    length, rate = 80 * mm, np.sqrt(2e4 / 5.0)
    elastic = pulled(cells, rod, 0.05 * mm)
    u = fem.solve(elastic).displacement
    wanted = 5.0 * rate * np.tanh(rate * length) * 0.05 * mm
    assert force_of(elastic, u) == pytest.approx(wanted, rel=2e-3)
    slid = pulled(cells, rod, 4 * mm)
    u = fem.solve(slid).displacement
    assert force_of(slid, u) == pytest.approx(2.0 * length, rel=1e-9)
    tension = fem.rod_forces(slid, u).tension[0]
    np.testing.assert_allclose(tension, 2.0 * 1 * mm * (np.arange(80) + 0.5), rtol=1e-8)


def test_a_bond_that_has_slid_stays_where_it_is():
    """Unloading is elastic, from where the bond has slid to."""
    cells, rod = held_bar()
    there = pulled(cells, rod, 4 * mm)
    u = fem.solve(there).displacement
    knows = fem.update_friction(there, u)
    again = fem.solve(knows, start=u)
    assert force_of(knows, again.displacement) == pytest.approx(0.16, rel=1e-8)
    (rod,) = knows.loads
    back = pulled(cells, rod, 4 * mm - 0.02 * mm)
    fell = 0.16 - force_of(back, fem.solve(back, start=u).displacement)
    rate = np.sqrt(2e4 / 5.0)
    assert fell == pytest.approx(5.0 * rate * np.tanh(rate * 80 * mm) * 0.02 * mm, rel=2e-3)


def test_a_motion_remembers_slip():
    """Pulled slowly beyond the strength and back: as the statics that is told of slip."""
    cells, rod = held_bar()
    rod = dataclasses.replace(
        rod, rod=dataclasses.replace(rod.rod, mass_per_length=jnp.asarray(1e-3))
    )
    steps = 20
    far = (
        4 * mm * np.concatenate([np.linspace(0, 1, steps // 2 + 1), np.full(steps // 2, 0.995)])
    )
    motion = fem.simulate(
        pulled(cells, rod, 0.0), 2.0, 2.0 / steps, end=far[:, None] * np.array([[1.0, 0.0]])
    )
    there = pulled(cells, rod, 4 * mm)
    knows = fem.update_friction(there, fem.solve(there).displacement)
    back = pulled(cells, knows.loads[0], 0.995 * 4 * mm)
    wanted = fem.solve(back, start=motion.displacements[-1]).displacement
    np.testing.assert_allclose(motion.displacements[-1], wanted, atol=2e-3 * mm)


# ---- transformations, mass, errors


def test_slopes_of_an_equilibrium_by_fibre_and_rubber_are_those_of_its_values():
    """By the winding angle, where the fibre lies, its stiffness and that of the rubber."""
    cells = mesh.box([0, 0, 0], [40 * mm, 10 * mm, 10 * mm], divisions=(4, 2, 2))
    sharp = fem.Newton(residual_tolerance=1e-12, step_tolerance=1e-11)

    def tip(numbers):
        angle, radius, axial, bending, shear = numbers
        along = jnp.linspace(0.02, 0.98, 40)
        turn = along * 40 * mm * jnp.tan(angle) / radius
        line = jnp.stack(
            [40 * mm * along, 5 * mm + radius * jnp.cos(turn), 5 * mm + radius * jnp.sin(turn)],
            axis=1,
        )
        rod = fem.embedded_rod(
            cells, line, axial_stiffness=axial, bending_stiffness=bending, spacing=4.3 * mm
        )
        rubber = material.NeoHookean(shear, 3 * shear)
        pull = fem.Traction(cells.facet_sets["right"], [2e4, 1e3, 0.0])
        held = (fem.Fixed(cells.node_sets["left"]),)
        problem = fem.problem(cells, rubber, supports=held, loads=(rod, pull))
        u = fem.solve(problem, newton=sharp).displacement[cells.node_sets["right"]]
        return jnp.sum(u[:, 0]) + jnp.sum(u[:, 2])

    at = jnp.array([0.5, 3 * mm, 20.0, 1e-5, 4e4])
    slope = jax.grad(tip)(at)
    for k, size in enumerate(np.asarray(at)):
        step = 1e-4 * size * np.eye(5)[k]
        ahead, behind, far, before = (float(tip(at + s * step)) for s in (1, -1, 2, -2))
        difference = (8 * (ahead - behind) - (far - before)) / (12 * 1e-4 * size)
        assert float(slope[k]) == pytest.approx(difference, rel=1e-6)


def test_solves_in_a_batch_are_those_one_by_one():
    rod = fem.embedded_rod(STRIP, MIDDLE, axial_stiffness=2.0, bending_stiffness=1e-5)
    force = fem.Force(STRIP.node_sets["right"], [1e-3, 1e-4], name="tip")
    problem = strip(rod, force)

    def tip(axial):
        bent = eqx.tree_at(lambda p: p.loads[0].axial_stiffness, problem, axial)
        return fem.solve(bent).displacement[-1]

    stiffness = jnp.array([1.0, 3.0])
    each = jnp.stack([tip(axial) for axial in stiffness])
    np.testing.assert_allclose(jax.jit(jax.vmap(tip))(stiffness), each, rtol=1e-7, atol=1e-14)


def test_the_mass_of_a_rod_is_that_of_its_length():
    heavy = fem.embedded_rod(
        BLOCK, np.stack([HELIX, HELIX]), radius=0.5 * mm, young_modulus=1e9, density=7800.0,
        matrix=RUBBER,
    )  # fmt: skip
    length = np.linalg.norm(np.diff(heavy.vertices(BLOCK.points)[0], axis=0), axis=1).sum()
    mass = heavy.lumped_mass(in_block(heavy))
    section = np.pi * (0.5 * mm) ** 2
    assert float(jnp.sum(mass)) == pytest.approx(2 * 7800 * section * length, rel=1e-12)
    assert jnp.all(mass >= 0)
    whole = float(fem.total_mass(in_block(heavy)))
    assert whole == pytest.approx(1000 * 6e-6 + float(jnp.sum(mass)), rel=1e-12)
    np.testing.assert_allclose(heavy.axial_stiffness, (1e9 - YOUNG) * section, rtol=1e-12)


def test_a_heavy_rod_swings_slower():
    """The first frequency of a bar that is stretched goes with the square root of the mass."""
    heavy = fem.embedded_rod(STRIP, MIDDLE, axial_stiffness=1e-6)
    own = 1000 * HEIGHT * DEPTH
    heavy = dataclasses.replace(heavy, mass_per_length=jnp.asarray(3 * own))
    start = strip().mesh.points
    pull = jnp.stack([1e-3 * start[:, 0], 0 * start[:, 0]], axis=1)
    sliding = fem.Fixed(STRIP.node_sets["left"]), fem.Fixed(np.arange(STRIP.num_nodes), (1,))
    quarter = 4 * LENGTH / np.sqrt(YOUNG / (1 - 0.09) / 1000) / 4
    ends = []
    for loads, times in (((), 1), ((heavy,), 2)):
        problem = strip(*loads, supports=sliding)
        motion = fem.simulate(
            problem, times * quarter, times * quarter / 40, start=(pull, 0 * pull)
        )
        ends.append(np.asarray(motion.displacements[:, -1, 0]))
    np.testing.assert_allclose(ends[1], ends[0], atol=0.03 * ends[0][0])


def test_a_network_drives_a_rod_as_a_motion_does():
    """A shortening that follows an input; a rod that slips beside it."""
    cells, slips = fem.bonded_rod(
        STRIP,
        fem.embedded_rod(STRIP, HIGH, radius=0.1 * mm, young_modulus=1e8, density=2e3),
        bond_strength=0.05, bond_stiffness=2e4, tie_stiffness=1e6,
    )  # fmt: skip
    slips = dataclasses.replace(slips, name="slips")
    muscle = fem.embedded_rod(STRIP, MIDDLE + OFF, axial_stiffness=5.0, name="muscle")
    problem = strip(muscle, slips, cells=cells)
    step, count = 2e-3, 5
    shares = 0.02 * np.arange(count + 1) / count
    motion = fem.simulate(problem, count * step, step, muscle=shares)
    tip = mesh.nearest_node(STRIP, MIDDLE[1])
    body = systems.FemBody(problem, driven=("muscle",), markers={"tip": tip})
    film = systems.simulate(
        systems.Network({"body": body}, {}, exposed=("body.muscle",)),
        count * step,
        step=step,
        save=count + 1,
        inputs={"body.muscle": lambda t: 0.02 * t / (count * step)},
    )
    place = np.asarray(film["body.tip_position"])
    moved = place[-1] - np.asarray(cells.points[tip])
    np.testing.assert_allclose(moved, motion.displacements[-1, tip], rtol=1e-2, atol=1e-7)
    assert abs(moved[1]) > 1e-5


def test_wrong_rods_say_what_to_do():
    with pytest.raises(ValueError, match=r"Give axial_stiffness, or radius"):
        fem.embedded_rod(STRIP, MIDDLE)
    with pytest.raises(ValueError, match=r"Give one row per corner"):
        fem.embedded_rod(STRIP, HELIX, axial_stiffness=1.0)
    with pytest.raises(ValueError, match=r"softer than the solid is a hole"):
        fem.embedded_rod(STRIP, MIDDLE, radius=1 * mm, young_modulus=1e4, matrix=RUBBER)
    with pytest.raises(ValueError, match=r"outside the mesh"):
        fem.embedded_rod(STRIP, [[0, 0], [2 * LENGTH, 0]], axial_stiffness=1.0)
    rod = fem.embedded_rod(STRIP, MIDDLE, axial_stiffness=1.0, clamped=(True, False))
    with pytest.raises(ValueError, match=r"need one rod that is not clamped"):
        fem.bonded_rod(STRIP, rod, bond_strength=1.0, material=RUBBER)
    cells, free = held_bar()
    with pytest.raises(ValueError, match=r"needs a mass of its own"):
        fem.simulate(pulled(cells, free, 0.0), 0.1, 0.05)
    with pytest.raises(ValueError, match=r"need one of \[\]"):
        fem.rod_forces(strip(), jnp.zeros_like(STRIP.points))
    with pytest.raises(ValueError, match=r"Use a solid mesh"):
        fem.problem(
            STRIP, RUBBER, kinematics=fem.Axisymmetric(), loads=(rod,),
            supports=(fem.Fixed(STRIP.node_sets["left"]),),
        )  # fmt: skip
