"""Equilibrium under vmap and jit: lanes, their status, gradients, and what they cost."""

import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from sorojax import Status, fem, material, mesh

GRID = mesh.rectangle([0, 0], [0.03, 0.01], divisions=(3, 1), order=1)
PROBLEM = fem.problem(
    GRID,
    material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3),
    kinematics=fem.PlaneStrain(1.0),
    supports=(fem.Fixed(GRID.node_sets["left"]),),
    loads=(fem.Traction(GRID.facet_sets["right"], jnp.zeros(2), name="end"),),
    formulation=fem.Displacement(),
)
TIGHT = fem.Newton(residual_tolerance=1e-12)
SHEAR = PROBLEM.material.shear_modulus
# more lanes than a system keeps factors; the last but one is crushed
SHEARS = jnp.linspace(0.7, 1.4, 6) * SHEAR
PULLS = jnp.array([1e4, 8e4, 3e4, 6e4, -1e9, 5e4])
FAILS = jnp.array([False, False, False, False, True, False])


def _problem(shear, pull):
    traction = jnp.stack([pull, 0.1 * pull])
    where = lambda p: (p.material.shear_modulus, p.loads[0].value)  # noqa: E731
    return eqx.tree_at(where, PROBLEM, (shear, traction))


def _solve(shear, pull):
    return fem.solve(_problem(shear, pull), newton=TIGHT, max_cuts=2, throw=False)


def _cost(shear, pull):
    solution = _solve(shear, pull)
    return jnp.sum(solution.displacement[:, 0]) * 1e3, solution.status


_both = jax.value_and_grad(_cost, (0, 1), has_aux=True)


def _close(a, b, tolerance=1e-9):
    return jnp.all(jnp.abs(a - b) <= tolerance * jnp.max(jnp.abs(b)))


@pytest.fixture(scope="module")
def loop():
    """Every lane alone: value, failed, gradients."""
    lanes = [_both(s, p) for s, p in zip(SHEARS, PULLS, strict=True)]
    value = jnp.stack([lane[0][0] for lane in lanes])
    failed = jnp.stack([lane[0][1] == Status.not_converged for lane in lanes])
    return value, failed, [jnp.stack([lane[1][k] for lane in lanes]) for k in range(2)]


def _check_lanes(found, loop):
    (value, status), slopes = found
    wanted, failed, wanted_slopes = loop
    assert jnp.array_equal(failed, FAILS)
    assert jnp.array_equal(status == Status.not_converged, FAILS)
    assert _close(value[~FAILS], wanted[~FAILS])
    for slope, want in zip(slopes, wanted_slopes, strict=True):
        assert _close(slope[~FAILS], want[~FAILS], 1e-8)
        assert jnp.isnan(slope[FAILS]).all() and jnp.isnan(want[FAILS]).all()


@pytest.mark.stress(45)
def test_lanes_are_those_of_a_loop_and_one_that_fails_leaves_the_others(loop):
    _check_lanes(jax.vmap(_both)(SHEARS, PULLS), loop)


def test_lanes_in_one_program_are_those_of_a_loop(loop):
    _check_lanes(jax.jit(jax.vmap(_both))(SHEARS, PULLS), loop)


def test_the_gradient_of_a_batch_is_the_batch_of_gradients(loop):
    keep = jnp.flatnonzero(~FAILS)

    def total(shears, pulls):
        return jnp.sum(jax.vmap(_cost)(shears, pulls)[0])

    slopes = jax.grad(total, (0, 1))(SHEARS[keep], PULLS[keep])
    for slope, want in zip(slopes, loop[2], strict=True):
        assert _close(slope, want[keep], 1e-8)


def test_every_lane_has_its_own_record_and_order_does_not_matter():
    there = jax.vmap(_solve)(SHEARS, PULLS)
    back = jax.vmap(_solve)(SHEARS[::-1], PULLS[::-1])
    assert [bool(s.reason) for s in there.stats] == FAILS.tolist()
    assert jnp.array_equal(there.load_fraction == 1.0, ~FAILS)
    assert there.iterations.tolist() == [s.iterations for s in there.stats]
    assert _close(back.displacement[::-1][~FAILS], there.displacement[~FAILS])


def test_lanes_need_fewer_factorisations_than_a_loop():
    solver, pulls = PROBLEM.space.system.solver, jnp.linspace(4e4, 8e4, 8)
    before = solver.num_factorisations
    for pull in pulls:
        _solve(SHEAR, pull)
    alone = solver.num_factorisations - before
    jax.vmap(lambda pull: _solve(SHEAR, pull))(pulls)
    assert solver.num_factorisations - before - alone <= 0.8 * alone


def test_nested_batches_keep_their_axes():
    pulls = jnp.array([1e4, 2e4])
    nested = jax.vmap(jax.vmap(_solve, (None, 0)), (0, None))(SHEARS[:3], pulls)
    assert nested.displacement.shape == (3, 2, *GRID.points.shape)
    assert len(nested.stats) == 6 and jnp.all(nested.status == Status.successful)
    alone = _solve(SHEARS[2], pulls[1]).displacement
    assert _close(nested.displacement[2, 1], alone)


@pytest.mark.parametrize("jacobian", [jax.jacrev, jax.jacfwd])
def test_many_derivatives_cost_one_factorisation_and_one_solve(jacobian, monkeypatch):
    solver, columns = PROBLEM.space.system.solver, []
    inner = solver._solve_many

    def counted(values, b, lead):
        columns.append(b.reshape(-1, b.shape[-1]).shape[0])
        return inner(values, b, lead)

    monkeypatch.setattr(solver, "_solve_many", counted)
    before = solver.num_factorisations
    _solve(SHEAR, jnp.array(3.3e4))
    alone = solver.num_factorisations - before

    def corners(load):
        problem = eqx.tree_at(lambda p: p.loads[0].value, PROBLEM, load)
        return fem.solve(problem, newton=TIGHT).displacement[-1]

    before = solver.num_factorisations
    jacobian(corners)(jnp.array([3.4e4, 1e2]))
    assert solver.num_factorisations - before <= alone + 1
    assert columns == [2]


def test_paths_in_a_batch_and_in_one_program():
    values = jnp.linspace(0.0, 6e4, 4)[:, None] * jnp.array([[1.0, 0.1]])

    def path(shear):
        problem = eqx.tree_at(lambda p: p.material.shear_modulus, PROBLEM, shear)
        return fem.solve_path(problem, newton=TIGHT, end=values)

    def cost(shear):
        found = path(shear)
        return jnp.sum(found.displacements), found.displacements

    alone = [jax.value_and_grad(cost, has_aux=True)(s) for s in SHEARS[:2]]
    lanes = jax.vmap(path)(SHEARS[:2])
    (_, states), slope = jax.jit(jax.value_and_grad(cost, has_aux=True))(SHEARS[1])
    assert _close(lanes.displacements, jnp.stack([a[0][1] for a in alone]))
    assert (lanes.status == Status.successful).tolist() == [True, True]
    assert _close(states, alone[1][0][1]) and jnp.allclose(slope, alone[1][1], rtol=1e-8)


def test_a_path_that_fails_in_a_batch_is_nan_from_there_on():
    scale = jnp.array([1.0, 1e6])

    def path(factor):
        values = factor * jnp.array([[0.0, 0.0], [-2e3, 0.0], [-4e3, 0.0]])
        return fem.solve_path(PROBLEM, newton=TIGHT, max_cuts=1, end=values)

    found = jax.vmap(path)(scale)
    finite = jnp.isfinite(found.displacements).all(axis=(2, 3))
    assert finite.tolist() == [[True, True, True], [True, False, False]]
    assert (found.status == Status.not_converged).tolist() == [False, True]


def test_a_start_may_differ_between_lanes():
    pulls = jnp.array([2e4, 3e4])
    starts = jax.vmap(lambda p: _solve(SHEAR, p).displacement)(pulls)

    def again(pull, start):
        return fem.solve(_problem(SHEAR, pull), start=start, newton=TIGHT)

    found = jax.vmap(again)(pulls, starts)
    assert _close(found.displacement, starts) and jnp.all(found.iterations == 1)


def _renumbered(order):
    """The problem on the same body with its nodes in another order: equal shapes, another
    pattern."""
    number = jnp.argsort(order).astype(jnp.int32)
    sets = (GRID.cells, GRID.node_sets, GRID.facet_sets)
    moved = jax.tree.map(lambda ids: number[ids], sets)
    grid = eqx.tree_at(
        lambda m: (m.points, m.cells, m.node_sets, m.facet_sets),
        GRID,
        (GRID.points[order], *moved),
    )
    return fem.problem(
        grid,
        PROBLEM.material,
        kinematics=PROBLEM.kinematics,
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Traction(grid.facet_sets["right"], jnp.array([2e4, 3e3]), name="end"),),
        formulation=fem.Displacement(),
    )


def test_another_problem_of_the_same_shapes_compiles_nothing_and_has_its_own_solver(caplog):
    orders = jnp.array([jnp.arange(8), [5, 2, 7, 0, 3, 6, 1, 4]])
    first, second = (_renumbered(order) for order in orders)
    assert first.space.system.num_values == second.space.system.num_values
    assert not jnp.array_equal(first.space.system.cols, second.space.system.cols)

    @eqx.filter_jit
    def inside(problem):
        return fem.solve(problem, newton=TIGHT)

    def states(problem):
        return fem.solve(problem, newton=TIGHT).displacement, inside(problem).displacement

    want = states(first)[0]
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        found = states(second)
    assert not [r for r in caplog.records if r.getMessage().startswith("Compiling")]
    assert _close(want, states(first)[1], 1e-12)
    for u in found:
        assert _close(u, want[orders[1]], 1e-12)
    returned = inside(second).problem  # static fields of the first, data of the second
    assert _close(fem.solve(returned, newton=TIGHT).displacement, found[0], 1e-12)
