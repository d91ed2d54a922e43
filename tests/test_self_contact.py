"""Contact of deformable surfaces: facets, search, two blocks, lists that follow motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh
from sorojax.contact.facet import over, shared
from sorojax.fem.contact.self_contact import through_own_wall
from sorojax.fem.equilibrium.linear import prepare
from sorojax.mesh.elements.base import flat_triangles
from sorojax.units import mm

WIDTH, YOUNG, PRESSURE = 12 * mm, 1e5, 2e3


@pytest.mark.parametrize("bow", [None, 0.1])
def test_a_point_stands_over_a_side(bow):
    """Height is the distance to the curve, and the slope of the height its normal."""
    corners = np.array([[0.0, 0.0], [1.0, 0.2], [0.5, 0.1 + (bow or 0.0)]])
    side = jnp.asarray(corners if bow else corners[:2])
    t = np.linspace(-1, 1, 20001)[:, None]
    middle, along = (corners[0] + corners[1]) / 2, (corners[1] - corners[0]) / 2
    curve = corners[2] + t * along + t**2 * (middle - corners[2])
    for point in ([0.3, -0.2], [0.6, 0.3], [0.5, 0.05]):
        found = over(side, jnp.array(point))
        nearest = np.sqrt(((curve - point) ** 2).sum(axis=1)).min()
        assert np.isclose(abs(found.height), nearest, rtol=1e-6)
        slope = jax.grad(lambda x: over(side, x).height)(jnp.array(point))
        assert np.allclose(slope, found.normal, rtol=0, atol=1e-6)
        assert found.weight == 1.0
    assert found.normal[1] < 0  # a side whose body is above it faces down
    assert over(side, jnp.array([2.0, 0.3])).weight == 0.0


def test_triangles_that_continue_each_other_share_one_weight():
    corners = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    both = corners[flat_triangles(mesh.Quad4())]

    @jax.vmap
    def seen(point):
        return jax.vmap(lambda piece: over(piece, point))(both)

    inside = jnp.array([[0.3, 0.4, 0.2], [0.5, 0.5, -0.1], [0.42, 0.6, 0.3], [0.7, 0.3, 0.1]])
    found = seen(inside)
    assert np.allclose(found.height, inside[:, 2:], rtol=1e-12)
    weights = jax.vmap(shared)(found.weight)
    assert np.allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    away = jax.vmap(shared)(seen(jnp.array([[1.5, 0.5, 0.1], [0.5, 1.05, 0.1]])).weight)
    assert float(away[0].sum()) == 0.0 and 0 < float(away[1].sum()) < 1
    totals = jax.vmap(shared)(jnp.linspace(0, 2, 201)[:, None]).sum(axis=1)
    assert np.all(np.diff(totals) >= 0) and totals[0] == 0 and totals[-1] == 1


def stacked(**options) -> fem.Problem:
    """A block on another one, with facets that do not match, pressed together."""
    low = mesh.rectangle([0, 0], [WIDTH, 6 * mm], divisions=(3, 2), element=mesh.Quad4())
    high = mesh.rectangle(
        [0, 6.1 * mm],
        [WIDTH, 12.1 * mm],
        divisions=(4, 2),
        element=mesh.Quad4(),
    )
    both = mesh.merge(low=low, high=high)
    facets, nodes = both.facet_sets, both.node_sets
    return fem.problem(
        both,
        material.neo_hookean(young_modulus=YOUNG, poisson_ratio=0.0),
        kinematics=fem.PlaneStrain(),
        supports=(
            fem.Fixed(nodes["low.bottom"], components=(1,)),
            fem.Fixed(nodes["low.left"], components=(0,)),
            fem.Fixed(nodes["high.left"], components=(0,)),
        ),
        loads=(
            fem.Traction(facets["high.top"], (0.0, -PRESSURE), name="weight"),
            fem.SelfContact(facets["low.top"], facets["high.bottom"], name="touch", **options),
            fem.Foundation(nodes["high.top"], jnp.array([0.0, 1e-3]), name="soft"),
        ),
        formulation=fem.Displacement(),
    )


def test_a_stack_of_blocks_passes_the_pressure_on():
    problem = stacked()
    solution = fem.solve(problem)
    found = fem.contact_state(problem, solution.displacement, "touch")
    law = problem.loads[1].law
    assert found.force.shape == (14, 2)
    assert np.abs(np.asarray(found.total)).max() < 0.01 * PRESSURE * WIDTH
    force = np.asarray(fem.residual(problem, solution.displacement))
    assert np.abs(force[problem.mesh.node_sets["high"], 1]).max() < 1e-6 * PRESSURE * WIDTH
    held = force[problem.mesh.node_sets["low.bottom"], 1].sum()
    assert np.isclose(held, PRESSURE * WIDTH, rtol=1e-6)
    low = float(found.force[:6, 1].sum())
    print(low, found, solution.stats)
    assert np.isclose(2 * low, -PRESSURE * WIDTH, rtol=2e-2)  # half of it from each side
    assert np.isclose(float(found.penetration), float(law.penetration(PRESSURE)), rtol=0.1)
    sunk = -float(solution.displacement[problem.mesh.node_sets["low.top"], 1].mean())
    assert np.isclose(sunk, PRESSURE * 6 * mm / YOUNG, rtol=0.03)


def test_stiffness_hardly_matters_and_a_clearance_is_kept():
    problem = stacked()
    law = problem.loads[1].law
    found = []
    for factor in (1.0, 2.0):
        stiff = eqx.tree_at(lambda p: p.loads[1].stiffness, problem, factor * law.stiffness)
        found.append(np.asarray(fem.solve(stiff).displacement))
    high = problem.mesh.node_sets["high.top"]
    sunk = [-u[high, 1].mean() for u in found]
    assert abs(sunk[1] / sunk[0] - 1) < 0.02
    wide = eqx.tree_at(lambda p: p.loads[1].value, problem, jnp.array(0.05 * mm))
    lifted = np.asarray(fem.solve(wide).displacement) - found[0]
    assert np.allclose(lifted[high, 1], 0.05 * mm, rtol=0.02)


def test_contact_of_bodies_carries_gradients():
    base = stacked()
    tight = fem.Newton(residual_tolerance=1e-12)

    def top(scale):
        problem = eqx.tree_at(
            lambda p: (p.loads[1].stiffness, p.mesh.points),
            base,
            (base.loads[1].stiffness * scale, base.mesh.points * (2 - scale)),
        )
        return 1e3 * jnp.mean(fem.solve(problem, newton=tight).displacement[-5:, 1])

    slope = jax.grad(top)(jnp.array(1.0))
    ahead, behind = top(jnp.array(1 + 1e-5)), top(jnp.array(1 - 1e-5))
    assert jnp.allclose(slope, (ahead - behind) / 2e-5, rtol=1e-6)


def test_lists_follow_the_motion():
    problem = stacked(reach=1 * mm)
    rest = jnp.zeros_like(problem.mesh.points)
    assert fem.update_contact_pairs(problem, rest) is problem
    moved = rest.at[problem.mesh.node_sets["high"], 0].set(9 * mm)
    slid = fem.update_contact_pairs(problem, moved)
    pairs = [
        np.asarray(p.loads[1].partners)[np.asarray(p.loads[1].real)] for p in (problem, slid)
    ]
    assert pairs[1].size < pairs[0].size
    far = fem.update_contact_pairs(
        problem, rest.at[problem.mesh.node_sets["high"], 1].set(9 * mm)
    )
    assert not bool(jnp.any(far.loads[1].real))
    pressed = moved.at[problem.mesh.node_sets["high"], 1].set(-0.2 * mm)
    state = fem.contact_state(slid, pressed, "touch")
    assert np.allclose(state.position[state.active, 0], 10.5 * mm, atol=2.1 * mm)
    assert np.allclose(state.gap[state.active], -0.1 * mm, rtol=1e-9)
    prepare(slid)  # the tangent has room for the new pairs
    with pytest.raises(ValueError, match="concrete"):
        jax.jit(lambda u: fem.update_contact_pairs(problem, u).loads[1].partners)(rest)


def test_the_back_of_a_wall_is_no_partner_but_its_neighbour_is():
    """Two walls on a foot: each has two sides, and they face each other across a gap."""
    block = mesh.rectangle([0, 0], [5 * mm, 4 * mm], divisions=(5, 4), element=mesh.Quad4())
    centres = np.asarray(block.points)[np.asarray(block.cells)].mean(axis=1) / mm
    notch = (centres[:, 1] > 1) & (centres[:, 0] > 2) & (centres[:, 0] < 3)
    cells = np.asarray(block.cells)[~notch]
    body = mesh.Mesh(block.points, cells, block.element)
    facets = mesh.boundary_facets(body)
    middle = np.asarray(block.points)[facets].mean(axis=1) / mm
    tall = middle[:, 1] > 1.2
    gap = np.flatnonzero(tall & (np.abs(middle[:, 0] - 2.5) < 0.6))
    outer = np.flatnonzero(tall & ((middle[:, 0] < 0.1) | (middle[:, 0] > 4.9)))
    first, second = (a.ravel() for a in np.meshgrid(gap, gap))
    assert not through_own_wall(body, facets, first, second, 1 * mm).any()
    first, second = (a.ravel() for a in np.meshgrid(gap, outer))
    facing = np.abs(middle[first, 1] - middle[second, 1]) < 0.1
    own = facing & (np.abs(middle[first, 0] - middle[second, 0]) < 2.1)
    assert through_own_wall(body, facets, first[own], second[own], 1 * mm).all()


def test_lists_follow_a_motion():
    """A block thrown along another one meets facets that it did not see at the start."""
    low = mesh.rectangle([0, 0], [24 * mm, 3 * mm], divisions=(12, 1), element=mesh.Quad4())
    high = mesh.rectangle(
        [0, 3.05 * mm], [4 * mm, 6.05 * mm], divisions=(2, 1), element=mesh.Quad4()
    )
    both = mesh.merge(low=low, high=high)
    facets, nodes = both.facet_sets, both.node_sets
    touch = fem.SelfContact(facets["low.top"], facets["high.bottom"], reach=2 * mm)
    rubber = material.neo_hookean(young_modulus=YOUNG, poisson_ratio=0.0, density=1000.0)
    problem = fem.problem(
        both,
        rubber,
        kinematics=fem.PlaneStrain(),
        loads=(touch,),
        free=True,
        supports=(fem.Fixed(nodes["low.bottom"]),),
        formulation=fem.Displacement(),
    )
    u, v = np.zeros(both.points.shape), np.zeros(both.points.shape)
    v[nodes["high"]] = [1.5, -0.3]

    def run(count, start, step=5e-4):
        return fem.simulate(problem, count * step, step, start=start)

    def total(motion):
        energies = motion.energies
        return np.asarray(energies.kinetic + energies.elastic + energies.loads)

    fine = total(run(40, (u, v), 1.25e-4))
    assert fine.max() < 1.001 * fine[0]
    whole = run(20, (u, v))
    assert float(whole.energies.loads.max()) > 0  # they met
    assert total(whole).max() < 1.001 * fine[0] and np.all(np.diff(total(whole)[2:]) < 0)
    moved = np.asarray(whole.displacements)[-1, nodes["high"]]
    assert moved[:, 0].mean() > 10 * mm  # far from the facets that were listed first
    bottom = np.asarray(both.points)[:, 1] + np.asarray(whole.displacements)[:, :, 1]
    assert bottom[:, nodes["high.bottom"]].min() > 2.2 * mm  # the low block gives way a little
    half = run(10, (u, v))
    again = run(10, half)
    assert again.end.listed is not None
    np.testing.assert_allclose(
        again.displacements[-1], whole.displacements[-1], atol=1e-9 * float(abs(moved).max())
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stiffness": -1.0}, "stiffness.*must be positive"),
        ({"reach": 0.0}, "reach.*must be positive"),
        ({"others": np.array([[0, 1, 2]])}, "need facets of 2 nodes"),
        ({"others": np.array([[0, 999]])}, "names nodes"),
    ],
)
def test_bad_self_contacts_are_refused(change, message):
    block = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(2, 2), element=mesh.Quad4())
    arguments = {"facets": block.facet_sets["bottom"]} | change
    with pytest.raises(ValueError, match=message):
        fem.problem(
            block,
            material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3),
            kinematics=fem.PlaneStrain(),
            supports=(fem.Fixed(block.node_sets["top"]),),
            loads=(fem.SelfContact(**arguments),),
        )


def test_bodies_of_different_cells_are_not_joined():
    quads = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(1, 1), element=mesh.Quad4())
    tris = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(1, 1), element=mesh.Tri3())
    with pytest.raises(ValueError, match="one kind of cells"):
        mesh.merge(a=quads, b=tris)
