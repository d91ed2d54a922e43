"""Limit points, bifurcations, cavities of given contents, vibration modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import ellipk

from sorojax import Status, fem, material, mesh
from sorojax._progress import listen
from sorojax.fem.equilibrium.jit import known_mask
from sorojax.fem.equilibrium.load_stepping import Stats
from sorojax.fem.problem import load_force
from sorojax.math.linalg import sparse

BULK = 1e5  # over the shear modulus: the closed form is incompressible


def _sphere(thickness: float) -> fem.Problem:
    """A spherical shell of inner radius 1, half of a section through its axis."""
    grid = mesh.rectangle(
        [1.0, 0.0], [1 + thickness, np.pi / 2], divisions=(1, 3), element=mesh.Quad9()
    )
    r, angle = np.asarray(grid.points).T
    points = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    points[np.asarray(grid.node_sets["top"]), 0] = 0.0
    shell = mesh.Mesh(points, grid.cells, grid.element)
    supports = (
        fem.Fixed(grid.node_sets["bottom"], components=(1,)),
        fem.Fixed(grid.node_sets["top"], components=(0,)),
    )
    air = fem.Pressure(grid.facet_sets["left"], 1.0, name="air")
    rubber = material.NeoHookean(1.0, BULK)
    return fem.problem(
        shell, rubber, kinematics=fem.Axisymmetric(), supports=supports, loads=(air,)
    )


def _sphere_pressure(stretch, thickness: float):
    """Incompressible neo-Hookean sphere of shear modulus 1, stretch of its inner radius."""
    outer = (1 + (stretch**3 - 1) / (1 + thickness) ** 3) ** (1 / 3)
    return 2 / outer + 1 / (2 * outer**4) - 2 / stretch - 1 / (2 * stretch**4)


def _wall(problem: fem.Problem):
    (air,) = problem.loads
    assert isinstance(air, fem.Pressure)
    return air.facets


def _stretches(problem: fem.Problem, displacements) -> np.ndarray:
    """Stretch of the inner radius, by the volume inside."""
    facets = _wall(problem)
    inside = [float(fem.enclosed_volume(problem, u, facets)) for u in displacements]
    rest = float(fem.enclosed_volume(problem, jnp.zeros_like(problem.mesh.points), facets))
    return (np.array(inside) / rest) ** (1 / 3)


def _limit(thickness: float) -> tuple[float, float]:
    found = minimize_scalar(
        lambda x: -_sphere_pressure(x, thickness),
        bounds=(1.1, 2),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return found.x, -found.fun


@pytest.fixture(scope="module")
def balloon():
    """A thick balloon blown up past its limit point, by arc length."""
    problem = _sphere(0.2)
    path = fem.continuation(problem, "air", step=0.08, until=lambda u, _: np.abs(u).max() > 1.0)
    return problem, path


@pytest.mark.stress(23)
def test_a_balloon_passes_its_limit_point(balloon):
    problem, path = balloon
    assert path.status == Status.successful
    stretches = _stretches(problem, path.displacements)
    assert np.allclose(path.values, _sphere_pressure(stretches, 0.2), rtol=5e-4)
    stretch, pressure = _limit(0.2)
    (limit,) = path.critical_points
    assert limit.kind == "limit point"
    assert np.isclose(limit.factor, pressure, rtol=5e-4)
    assert np.isclose(_stretches(problem, [limit.displacement])[0], stretch, rtol=1e-3)
    past = stretches > stretch
    assert past.sum() >= 3 and np.array_equal(path.negative_eigenvalues, past.astype(int))


def test_a_thin_balloon_has_the_limit_point_of_a_membrane():
    thickness = 0.002
    problem = _sphere(thickness)
    path = fem.continuation(
        problem, "air", step=2e-4, largest_step=0.1, until=lambda u, _: np.abs(u).max() > 0.5
    )
    (limit,) = path.critical_points
    stretch = _stretches(problem, [limit.displacement])[0]
    assert abs(stretch - 7 ** (1 / 6)) < 2 * thickness
    assert np.isclose(limit.factor, _limit(thickness)[1], rtol=1e-3)


@pytest.mark.stress(23)
def test_volume_control_finds_the_states_of_the_arc(balloon):
    problem, path = balloon
    facets = _wall(problem)
    picked = np.array([2, len(path) - 1])
    volumes = [fem.enclosed_volume(problem, path.displacements[k], facets) for k in picked]
    found = fem.volume_path(problem, air=jnp.stack(volumes))
    assert found.status == Status.successful
    assert jnp.allclose(found.pressures, path.factors[picked], rtol=1e-8)
    assert jnp.allclose(found.displacements, path.displacements[picked], atol=1e-8)


@pytest.mark.parametrize("name", ["air", None])
def test_problems_of_a_path_have_the_loads_of_its_states(name):
    path = fem.continuation(_sphere(0.2), name, step=0.08, max_states=3)
    for k in (1, 2):
        problem, u = path.problem_at(k), path.displacements[k]
        free = ~np.asarray(known_mask(problem.supports, *u.shape)).reshape(u.shape)
        force = np.asarray(fem.residual(problem, u)).reshape(u.shape)[free]
        assert np.abs(force).max() < 1e-7 * np.abs(load_force(problem, u)).max()


def test_a_path_goes_on_where_it_ended(balloon):
    problem, _ = balloon
    told = []
    with listen(told.append):
        first = fem.continuation(problem, "air", step=0.08, max_states=3)
    more = fem.continuation(problem, "air", start=first, max_states=3)
    assert len(first) == len(more) == 3 and told[-1].label == "continuation"
    assert jnp.array_equal(more.factors[0], first.factors[-1])
    stretches = _stretches(problem, more.displacements)
    assert np.all(np.diff(stretches) > 0)
    assert np.allclose(more.values, _sphere_pressure(stretches, 0.2), rtol=5e-4)


@pytest.mark.stress(22, 23)
def test_plain_load_steps_end_below_the_limit_point(balloon):
    problem, _ = balloon
    solution = fem.solve(problem, max_cuts=4, throw=False)
    stats = solution.stats
    assert isinstance(stats, Stats)
    assert solution.status == Status.not_converged and stats.reason
    reached = stats.steps[-1].fraction
    stretch, pressure = _limit(0.2)
    assert 0.8 * pressure < reached < 1.001 * pressure
    here = _stretches(problem, [solution.displacement])[0]
    assert here < stretch and np.isclose(_sphere_pressure(here, 0.2), reached, rtol=1e-3)


def test_sealed_gas_obeys_its_law_past_the_limit_point(balloon):
    problem, _ = balloon
    still = jnp.zeros_like(problem.mesh.points)
    rest = float(fem.enclosed_volume(problem, still, _wall(problem)))
    gas = fem.Gas(rest, pressure=1.6, exponent=1.2, ambient=0.1)
    solution = fem.solve_volume(problem, air=gas)
    (pressure,), (volume,) = solution.pressures, solution.volumes
    assert jnp.isclose((pressure + 0.1) * volume**1.2, 1.7 * rest**1.2, rtol=1e-8)
    stretch = _stretches(problem, [solution.displacement])[0]
    assert np.isclose(pressure, _sphere_pressure(stretch, 0.2), rtol=5e-4)
    assert stretch > _limit(0.2)[0]  # where given pressure has no stable state


@pytest.mark.parametrize("sealed", [False, True])
def test_derivatives_of_cavities_agree_with_central_differences(balloon, sealed):
    problem, _ = balloon
    rest = 2 * np.pi / 3

    def answer(x):
        here = eqx.tree_at(lambda p: p.material.shear_modulus, problem, x[0])
        inside = fem.Gas(rest, pressure=0.4, ambient=x[1]) if sealed else rest * (2 + x[1])
        solution = fem.solve_volume(here, newton=fem.Newton(1e-12), air=inside)
        return solution.pressures[0] + jnp.sum(solution.displacement[:, 0])

    at, h = jnp.array([1.0, 0.2]), 1e-4
    exact = jax.grad(answer)(at)
    steps = h * jnp.eye(2)
    difference = jnp.stack([(answer(at + d) - answer(at - d)) / (2 * h) for d in steps])
    assert jnp.allclose(exact, difference, rtol=1e-6, atol=1e-8)


# A column, clamped at its left end.
LENGTH, HEIGHT, YOUNG, POISSON, DENSITY = 1.0, 0.05, 1e6, 0.3, 1000.0
BENDING = YOUNG / (1 - POISSON**2) * HEIGHT**3 / 12
EULER = np.pi**2 * BENDING / (4 * LENGTH**2)


@pytest.fixture(scope="module")
def column():
    grid = mesh.rectangle(
        [0, -HEIGHT / 2], [LENGTH, HEIGHT / 2], divisions=(10, 1), element=mesh.Quad9()
    )
    rubber = material.neo_hookean(young_modulus=YOUNG, poisson_ratio=POISSON, density=DENSITY)
    push = fem.Traction(grid.facet_sets["right"], [-EULER / HEIGHT, 0.0], name="push")
    return fem.problem(
        grid,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(push,),
    )


@pytest.fixture(scope="module")
def buckled(column):
    return fem.continuation(column, "push", step=0.4, until=lambda _, factor: factor > 1.1)


def test_a_column_buckles_under_the_load_of_euler(column, buckled):
    linear = fem.critical_loads(column, "push", count=2)
    assert np.allclose(linear.factors, [1.0, 9.0], rtol=0.06)
    (point,) = buckled.critical_points
    assert point.kind == "bifurcation"
    # shear and compression, of the order of (HEIGHT / LENGTH)^2
    assert np.isclose(point.factor, 1.0, rtol=1e-2)
    assert list(buckled.negative_eigenvalues)[:: len(buckled) - 1] == [0, 1]
    near = fem.critical_loads(
        column,
        "push",
        displacement=point.displacement * 0.99,
        factor=float(point.factor) * 0.99,
    )
    assert np.isclose(near.factors[0], point.factor, rtol=1e-4)
    tip = mesh.nearest_node(column.mesh, [LENGTH, 0.0])
    assert abs(abs(point.shape[tip, 1]) - 1) < 1e-2


def test_a_solution_past_the_critical_load_says_that_it_is_not_stable(column):
    at = fem.solve(fem.with_load(column, "push", 1.2 * column.loads[0].value))
    assert "not stable: negative eigenvalues of the tangent 1" in str(at)
    path = fem.solve_path(column, push=np.outer([0.5, 1.2], column.loads[0].value))
    assert "not stable: negative eigenvalues of the tangent 0, 1" in str(path)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_buckled_branch_is_stable_and_goes_to_either_side(column, buckled, side):
    (point,) = buckled.critical_points
    branch = fem.continuation(
        column,
        "push",
        start=point,
        step=side * 20.0,
        largest_step=0.1,
        until=lambda u, _: np.abs(u[:, 1]).max() > 0.3,
    )
    tip = mesh.nearest_node(column.mesh, [LENGTH, 0.0])
    sideways = np.asarray(branch.displacements[1:, tip, 1])
    assert np.all(side * np.sign(point.shape[tip, 1]) * sideways > 0)
    assert np.all(np.asarray(branch.negative_eigenvalues[1:]) == 0)
    # the elastica: half the angle of its tip gives deflection and load
    modulus = np.sin(np.linspace(0, 0.5, 200))
    K = ellipk(modulus**2)
    load = np.interp(np.abs(sideways), 2 * modulus / K, (2 * K / np.pi) ** 2)
    assert np.allclose(branch.factors[1:] / point.factor, load, atol=3e-3) and load[-1] > 1.02


def test_an_imperfection_leads_to_the_branch(column, buckled):
    (point,) = buckled.critical_points
    seeded = fem.with_imperfection(column, point.shape, 1e-3 * LENGTH)
    moved = jnp.abs(seeded.mesh.points - column.mesh.points)
    assert jnp.isclose(jnp.max(moved), 1e-3 * LENGTH, rtol=1e-12)
    path = fem.continuation(
        seeded,
        "push",
        step=0.4,
        largest_step=0.05,
        until=lambda u, _: np.abs(u[:, 1]).max() > 0.1,
    )
    assert path.critical_points == () and np.all(np.asarray(path.negative_eigenvalues) == 0)


def test_vibration_modes_of_a_cantilever(column):
    idle = eqx.tree_at(lambda p: p.loads[0].value, column, jnp.zeros(2))
    modes = fem.eigenmodes(idle, count=3)
    beam = np.sqrt(BENDING / (DENSITY * HEIGHT)) / (2 * np.pi * LENGTH**2)
    assert np.allclose(modes.frequencies[:2], beam * np.array([1.8751, 4.6941]) ** 2, rtol=2e-2)
    system, mass = column.space.system, fem.mass_matrix(column)
    flat = modes.shapes.reshape(3, -1)
    gram = flat @ jnp.stack([sparse.product(system, mass, v) for v in flat]).T
    assert jnp.allclose(gram, jnp.eye(3), atol=1e-10)
    q = jnp.array([0.1, -0.02, 0.03])
    assert jnp.allclose(
        fem.modal_coordinates(modes, fem.modal_displacement(modes, q)), q, atol=1e-10
    )
    assert fem.modal_force(modes, jnp.ones_like(modes.displacement)).shape == (3,)


def test_modes_past_a_bifurcation_are_found_on_the_indefinite_tangent(column, buckled):
    push = eqx.tree_at(
        lambda p: p.loads[0].value, column, column.loads[0].value * buckled.factors[-1]
    )
    u = buckled.displacements[-1]
    vibration, stiffness = fem.eigenmodes(push, u, 2), fem.tangent_modes(push, u, 2)
    for modes in (vibration, stiffness):
        assert modes.eigenvalues[0] < 0 < modes.eigenvalues[1]
    assert vibration.frequencies[0] < 0


def test_masses_add_up(column):
    total = DENSITY * LENGTH * HEIGHT
    assert jnp.isclose(fem.total_mass(column), total, rtol=1e-12)
    lumped = fem.lumped_mass(column)
    assert jnp.all(lumped > 0) and jnp.isclose(jnp.sum(lumped), 2 * total, rtol=1e-12)
    system, shift = column.space.system, jnp.tile(jnp.array([1.0, 0.0]), column.mesh.num_nodes)
    pushed = sparse.product(system, fem.mass_matrix(column), shift)
    assert jnp.isclose(jnp.sum(pushed * shift), total, rtol=1e-12)
    x = column.mesh.points[:, 0]  # a rotation: the second moment is exact as well
    spin = jnp.zeros((column.mesh.num_nodes, 2)).at[:, 1].set(x).ravel()
    moment = jnp.sum(spin * sparse.product(system, fem.mass_matrix(column), spin))
    assert jnp.isclose(moment, total * LENGTH**2 / 3, rtol=1e-12)


def test_bad_calls_name_the_remedy(balloon, column):
    problem, path = balloon
    with pytest.raises(ValueError, match="no load or moved support is called 'gas'"):
        fem.continuation(problem, "gas")
    with pytest.raises(ValueError, match="abs\\(step\\)"):
        fem.continuation(problem, "air", step=0.0)
    with pytest.raises(ValueError, match="some of the pressures"):
        fem.solve_volume(problem, gas=1.0)
    with pytest.raises(ValueError, match="some of the pressures"):
        fem.solve_volume(column, push=1.0)
    with pytest.raises(ValueError, match="must be positive"):
        fem.solve_volume(problem, air=-1.0)
    with pytest.raises(ValueError, match="has no density"):
        fem.eigenmodes(problem)
    with pytest.raises(ValueError, match="`count` is 0"):
        fem.tangent_modes(problem, count=0)
    with pytest.raises(ValueError, match="is not stable"):
        air = float(path.factors[-1])
        fem.critical_loads(problem, "air", displacement=path.displacements[-1], factor=air)


def test_a_volume_out_of_reach_keeps_the_last_converged_state(balloon):
    problem, _ = balloon
    with pytest.raises(fem.ConvergenceError, match="change of volume") as error:
        fem.solve_volume(problem, newton=fem.Newton(max_iterations=3), max_cuts=1, air=100.0)
    solution = error.value.solution
    assert isinstance(solution.stats, Stats) and solution.stats.reason
    assert jnp.all(jnp.isfinite(solution.displacement))
