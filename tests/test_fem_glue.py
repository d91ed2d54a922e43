"""Two bodies glued over facets that do not match."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh, systems

SHARP = fem.Newton(residual_tolerance=1e-12, step_tolerance=1e-9)
LAW = material.StVenantKirchhoff(1.0, 2.0, density=1.0)
DEPTH = fem.PlaneStrain(1.0)


def _stacked(element, below=2, above=3) -> mesh.Mesh:
    """One unit cube on another, with different cells."""
    dim = element.dim
    make: Any = mesh.rectangle if dim == 2 else mesh.box
    low, high = np.zeros(dim), np.ones(dim)
    low[-1], high[-1] = 1.0, 2.0
    return mesh.merge(
        a=make([0.0] * dim, [1.0] * dim, divisions=(below,) * dim, element=element),
        b=make(low, high, divisions=(above,) * dim, element=element),
    )


def _pulled(element, **options) -> Any:
    """The stack pulled from both ends, held where it could move rigidly only."""
    both, dim = _stacked(element), element.dim
    seam = fem.glue(both, both.facet_sets["b.bottom"], both.facet_sets["a.top"], **options)
    supports = [fem.Fixed(both.node_sets["a.bottom"], components=(dim - 1,))]
    for axis in range(dim - 1):
        flat = mesh.nodes_where(both, lambda p, axis=axis: p[axis] < 1e-9)
        supports.append(fem.Fixed(flat, components=(axis,)))
    pull = fem.Traction(both.facet_sets["b.top"], [0.0] * (dim - 1) + [1e-4])
    kinematics = DEPTH if dim == 2 else fem.Solid()
    return fem.problem(
        both, LAW, kinematics=kinematics, supports=tuple(supports), loads=(seam, pull)
    )


@pytest.mark.parametrize(
    "element",
    [
        mesh.Tri3(),
        mesh.Quad8(),
        pytest.param(mesh.Tri6(), marks=pytest.mark.slow),
        mesh.Hex8(),
        mesh.Tet4(),
        pytest.param(mesh.Tet10(), marks=pytest.mark.slow),
    ],
    ids=lambda element: element.name,
)
def test_a_constant_stress_passes_between_facets_that_do_not_match(element):
    problem = _pulled(element)
    u = fem.solve(problem, newton=SHARP).displacement
    stress = fem.cauchy_stress(problem, u)
    up = stress[..., element.dim - 1, element.dim - 1]
    assert jnp.ptp(up) < 1e-9 * jnp.max(up)
    # the layer opens by the stress over its stiffness
    last = element.dim - 1
    both = problem.mesh
    lifted = u[both.node_sets["b.bottom"], last] - jnp.max(u[both.node_sets["a.top"], last])
    want = 1e-4 / problem.loads[0].stiffness
    np.testing.assert_allclose(lifted, want, rtol=1e-4)
    cell = 1e-4 * (5 / 12)  # what a cell of mean size lengthens by, at E = 2.7
    assert want < 1e-3 * cell / 2.7


def _beam(n: int, glued: bool) -> float:
    """Deflection of the tip of a cantilever, in one piece or glued of two halves, one upon
    the other, of cells whose numbers are 2 to 3."""
    if glued:
        cells = mesh.merge(
            a=mesh.rectangle([0, 0], [6, 0.5], divisions=(4 * n, n), element=mesh.Quad8()),
            b=mesh.rectangle([0, 0.5], [6, 1.0], divisions=(6 * n, n), element=mesh.Quad8()),
        )
        loads = (fem.glue(cells, cells.facet_sets["b.bottom"], cells.facet_sets["a.top"]),)
    else:
        cells = mesh.rectangle([0, 0], [6, 1], divisions=(24, 4), element=mesh.Quad8())
        loads = ()
    wall = mesh.nodes_where(cells, lambda p: p[0] < 1e-9)
    pull = fem.Gravity([0.0, -1e-5])
    problem = fem.problem(
        cells, LAW, kinematics=DEPTH, supports=(fem.Fixed(wall),), loads=(*loads, pull)
    )
    u = fem.solve(problem, newton=SHARP).displacement
    return float(u[mesh.nearest_node(cells, [6.0, 1.0]), 1])


def test_a_beam_glued_of_two_bends_as_one():
    whole = _beam(4, glued=False)
    errors = [abs(_beam(n, glued=True) / whole - 1) for n in (1, 2)]
    assert errors[1] < 5e-3 and errors[1] < errors[0] / 4


def _rings(inner: int, outer: int) -> mesh.Mesh:
    """A quarter of a ring in a ring, their facets of straight sides across each other."""
    parts = {}
    for name, low, high, count in (("a", 1.0, 1.5, inner), ("b", 1.5, 2.0, outer)):
        grid = mesh.rectangle(
            [low, 0.0],
            [high, np.pi / 2],
            divisions=(1 + count // 5, count),
            element=mesh.Quad4(),
        )
        r, angle = np.asarray(grid.points).T
        points = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
        parts[name] = mesh.Mesh(
            points, grid.cells, grid.element, grid.node_sets, grid.facet_sets
        )
    return mesh.merge(**parts)


def _blown(inner: int, outer: int) -> fem.Problem:
    both = _rings(inner, outer)
    seam = fem.glue(both, both.facet_sets["b.left"], both.facet_sets["a.right"])
    bottom = mesh.nodes_where(both, lambda p: p[1] < 1e-9)
    left = mesh.nodes_where(both, lambda p: p[0] < 1e-9)
    supports = fem.Fixed(bottom, components=(1,)), fem.Fixed(left, components=(0,))
    air = fem.Pressure(both.facet_sets["a.left"], 1e-4, name="air")
    return fem.problem(both, LAW, kinematics=DEPTH, supports=supports, loads=(seam, air))


def test_a_curved_seam_is_free_of_stress_at_rest_and_carries_a_pressure():
    """Lame's solution of a thick ring under inner pressure."""
    problem = _blown(9, 13)
    rest = fem.with_load(problem, "air", jnp.zeros(()))
    assert jnp.max(jnp.abs(fem.residual(rest, jnp.zeros_like(rest.mesh.points)))) < 1e-11
    found = []
    for blown in (problem, _blown(18, 26)):
        u = fem.solve(blown, newton=SHARP).displacement
        outside = blown.mesh.node_sets["b.right"]
        radial = jnp.sqrt(jnp.sum((blown.mesh.points + u)[outside] ** 2, axis=1)) - 2.0
        found.append(np.asarray(radial))
    shear, bulk = 1.0, 2.0
    lame = bulk - 2 / 3 * shear
    a, b = 1.0, 2.0
    want = 1e-4 * a**2 / (b**2 - a**2) * (b / (2 * (lame + shear)) + b**2 / b / (2 * shear))
    errors = [np.abs(r / want - 1).max() for r in found]
    assert errors[1] < 0.01 and errors[1] < errors[0] / 2


@pytest.mark.parametrize("element", [mesh.Quad4(), mesh.Hex8()], ids=lambda e: e.name)
def test_a_rigid_motion_costs_nothing(element):
    problem = _pulled(element)
    seam, points = problem.loads[0], problem.mesh.points
    axis = None if element.dim == 2 else jnp.asarray([1.0, 2.0, -0.5])
    u = fem.rotated(points, 2.0, jnp.asarray([3.0, 1.0, 0.5][: element.dim]), axis) + 0.7
    alone = eqx.tree_at(lambda p: p.loads, problem, (seam,))
    assert jnp.max(jnp.abs(fem.residual(alone, u))) < 1e-9 * float(seam.stiffness)
    assert seam.potential(problem, u) < 1e-24 * float(seam.stiffness)
    apart = u.at[problem.mesh.node_sets["b"]].add(1e-3)
    energy = 0.5 * float(seam.stiffness) * element.dim * 1e-6
    np.testing.assert_allclose(seam.potential(problem, apart), energy, rtol=1e-9)


def _flying() -> Any:
    """Two glued blocks in free flight, set off with a spin that stretches them."""
    both = _stacked(mesh.Quad4(), 1, 2)
    seam = fem.glue(both, both.facet_sets["b.bottom"], both.facet_sets["a.top"])
    problem = fem.problem(both, LAW, kinematics=DEPTH, supports=(), loads=(seam,), free=True)
    x, y = both.points.T
    v = 0.3 * jnp.stack([-y, x], axis=1) + 0.1 * jnp.stack([x * y, y**2], axis=1)
    return problem, v


def test_glued_blocks_in_free_flight_keep_energy_and_momenta():
    problem, v = _flying()
    motion = fem.simulate(
        problem,
        4.0,
        0.1,
        start=(jnp.zeros_like(v), v),
        method=fem.EnergyMomentum(),
        newton=SHARP,
    )
    p, spin = fem.momentum(motion)
    np.testing.assert_allclose(p, jnp.broadcast_to(p[0], p.shape), atol=1e-10)
    np.testing.assert_allclose(spin, jnp.broadcast_to(spin[0], spin.shape), rtol=1e-9)
    energies = motion.energies
    total = energies.kinetic + energies.elastic + energies.loads
    np.testing.assert_allclose(total, jnp.full_like(total, total[0]), rtol=1e-8)
    gap = jnp.sqrt(2 * energies.loads / problem.loads[0].stiffness)
    assert jnp.max(gap) < 1e-3  # nothing came apart


def test_a_network_moves_glued_bodies_as_simulate_does():
    problem, v = _flying()
    network = systems.Network({"blocks": systems.FemBody(problem, v=v)}, {})
    film = systems.simulate(network, 0.3, step=0.1, save=4)
    alone = fem.simulate(problem, 0.3, 0.1, start=(jnp.zeros_like(v), v))
    assert film.status == Status.successful
    np.testing.assert_allclose(film.state["blocks"]["u"], alone.displacements, atol=1e-8)


def test_slopes_by_nodes_and_material_agree_with_differences():
    problem = _blown(2, 3)
    way = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, problem.mesh.points.shape))

    def answer(shift, modulus):
        at = eqx.tree_at(
            lambda p: (p.mesh.points, p.material.shear_modulus),
            problem,
            (problem.mesh.points + shift * way, modulus),
        )
        u = fem.solve(at, newton=SHARP).displacement
        return jnp.sum(u * jnp.cos(way)) * 1e4

    at, steps = (jnp.asarray(0.0), jnp.asarray(1.0)), (1e-4, 1e-3)
    slopes = jax.grad(answer, argnums=(0, 1))(*at)
    for k, step in enumerate(steps):
        low2, low, high, high2 = (
            answer(*(a + s * step * (j == k) for j, a in enumerate(at))) for s in (-2, -1, 1, 2)
        )
        want = (low2 - 8 * low + 8 * high - high2) / (12 * step)
        np.testing.assert_allclose(slopes[k], want, rtol=1e-6)


def test_bad_calls_name_the_remedy():
    both = _stacked(mesh.Tri3())
    with pytest.raises(ValueError, match="do not face each other"):
        fem.glue(both, both.facet_sets["b.top"], both.facet_sets["a.top"])
    with pytest.raises(ValueError, match="corners of no facet"):
        fem.glue(both, both.facet_sets["b.bottom"], np.array([[0, 8]]))
    with pytest.raises(ValueError, match="stiffness"):
        _pulled(mesh.Tri3(), stiffness=-1.0)
