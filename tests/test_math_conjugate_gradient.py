"""Conjugate gradients with multigrid: the answers of the direct solver, in one program."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh
from sorojax.fem.checks import rigid_modes
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.math.linalg import conjugate_gradient as cg, multigrid as block_rows, sparse
from sorojax.math.linalg.multigrid import cycle, hierarchy, multigrid

SETTINGS = sparse.ConjugateGradient(coarsest=60)


def _cantilever(divisions, solver):
    grid = mesh.rectangle([0, 0], [0.03, 0.01], divisions=divisions, element=mesh.Quad4())
    return fem.problem(
        grid,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45),
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Traction(grid.facet_sets["right"], jnp.array([0.0, 2e3]), name="end"),),
        solver=solver,
    )


DIRECT, OURS = _cantilever((12, 4), "direct"), _cantilever((12, 4), SETTINGS)


def _matrix(problem):
    """Tangent at rest with its supports, the mass, and a right-hand side that they allow."""
    u = jnp.zeros_like(problem.mesh.points)
    prepared = prepare(problem)
    values = linearise(problem, prepared, u, u).values
    system, known = problem.space.system, prepared.known
    b = jax.random.normal(jax.random.key(1), (system.size,))
    values = sparse.fix(system, values, known) / jnp.max(jnp.abs(values))
    return system, values, jnp.where(known, 0.0, b), known


@pytest.fixture(scope="module")
def held():
    return _matrix(OURS)


def _dense(system, values):
    A = jnp.zeros((system.size, system.size)).at[system.rows, system.cols].set(values)
    return A + jnp.triu(A, 1).T


def _close(a, b, tolerance):
    return jnp.all(jnp.abs(a - b) <= tolerance * jnp.max(jnp.abs(b)))


def test_lines_hold_lists_of_any_length():
    random = np.random.default_rng(0)
    lengths = np.append(random.integers(0, 7, 40), 90)  # a long one does not widen all
    owner = np.repeat(np.arange(41), lengths)
    first, second = random.integers(0, 9, (2, len(owner)))
    A, B = random.standard_normal((9, 2, 3)), random.standard_normal((9, 3, 4))
    exact = np.zeros((41, 2, 4))
    np.add.at(exact, owner, A[first] @ B[second])
    pairs = block_rows.products(owner, first, second, 9, 41)
    assert np.allclose(block_rows.sum_products(pairs, jnp.asarray(A), jnp.asarray(B)), exact)
    assert pairs.first.shape[2] < 20
    rows, x = block_rows.rows(owner, first, 41), random.standard_normal((9, 3))
    blocks = random.standard_normal((len(owner), 2, 3))
    wanted = np.zeros((41, 2))
    np.add.at(wanted, owner, np.einsum("eij,ej->ei", blocks, x[first]))
    found = block_rows.block_matrix(rows, jnp.asarray(blocks)) @ jnp.asarray(x)
    assert np.allclose(found, wanted)


def test_a_residual_is_small_everywhere(held):
    """An unknown that is 1e8 times as stiff hardly enters the norm of the energy."""
    system, values, b, _ = held
    stiff = jnp.argmax(jnp.abs(b))
    scale = jnp.ones(system.size).at[stiff].set(1e4)
    values = values * scale[np.asarray(system.rows)] * scale[np.asarray(system.cols)]
    b = b.at[stiff].set(1e-3)
    tolerance = 1e-6
    levels = multigrid(OURS.space.system.iterative.maps, values)
    found = cg.iterate(levels, b, tolerance, 1000)
    left = jnp.abs(sparse.product(system, values, found.x) - b)
    assert found.converged
    assert jnp.max(left) <= 100 * tolerance * jnp.max(jnp.abs(b))


@pytest.mark.parametrize("dim", [2, 3])
def test_every_level_holds_the_rigid_motions(dim):
    make = mesh.rectangle if dim == 2 else mesh.box
    element = mesh.Tri3() if dim == 2 else mesh.Tet4()
    cells = make([0] * dim, [2] * dim, divisions=(9,) * dim, element=element)
    system = sparse.from_cells(cells.num_nodes, np.asarray(cells.cells), dim)
    maps = hierarchy(np.asarray(cells.points), system.rows, system.cols, 12)
    assert len(maps.levels) > 1
    motion = rigid_modes(np.asarray(cells.points), fem.Solid())
    motion = np.moveaxis(motion, 0, 2)
    for level in maps.levels:  # each is in the span of what the next one can say
        T = np.asarray(level.tentative)
        groups = np.asarray(level.prolongation.cols)  # of all blocks of a row
        owner = np.asarray(level.prolonged)
        cols = np.zeros(len(owner), int)
        entries = np.asarray(level.prolongation.at.entries)
        cols[entries[entries < len(owner)]] = groups[entries < len(owner)]
        group = cols[np.asarray(level.owned)]
        coarse = np.zeros((group.max() + 1, T.shape[2], motion.shape[2]))
        for k in range(len(coarse)):
            rows = group == k
            A, b = T[rows].reshape(-1, T.shape[2]), motion[rows].reshape(-1, motion.shape[2])
            coarse[k], *_ = np.linalg.lstsq(A, b, rcond=None)
        assert np.allclose(np.einsum("num,nmk->nuk", T, coarse[group]), motion, atol=1e-12)
        motion = coarse


def test_answers_and_derivatives_are_exact(held):
    system, values, b, known = held
    wave = jnp.cos(jnp.arange(1.0 * system.num_values))

    def cost(amount, b):
        matrix = sparse.fix(system, (1 + amount * wave) * values, known)
        x = sparse.solve(system, matrix, b)
        return jnp.sum(x**3), x

    def slopes(amount, b):  # not compiled as one: the solves share a program then
        def by_both(amount):
            return jax.grad(cost, (0, 1), has_aux=True)(amount, b)

        return jax.jvp(by_both, (amount,), (jnp.ones_like(amount),))

    ((by_amount, by_b), x), ((second, _), rate) = slopes(jnp.array(0.1), b)
    A = _dense(system, sparse.fix(system, (1 + 0.1 * wave) * values, known))
    C = _dense(system, jnp.where(known[system.rows] | known[system.cols], 0, wave * values))
    exact = jnp.linalg.solve(A, b)
    first = -jnp.linalg.solve(A, C @ exact)
    twice = -2 * jnp.linalg.solve(A, C @ first)
    assert _close(x, exact, 1e-9) and _close(rate, first, 1e-8)
    assert jnp.allclose(by_amount, 3 * exact**2 @ first, rtol=1e-8)
    free = jnp.linalg.solve(A, 3 * exact**2)
    assert _close(by_b, free, 1e-8)
    assert jnp.allclose(second, jnp.sum(6 * exact * first**2 + 3 * exact**2 * twice), rtol=1e-7)


def test_rows_of_right_hand_sides(held):
    system, values, b, _ = held
    exact = jnp.linalg.solve(_dense(system, values), b)
    found = system.solver.factor(np.asarray(values)).solve(np.stack([b, 2 * b, 0 * b]))
    assert _close(found, jnp.stack([exact, 2 * exact, 0 * exact]), 1e-9)


def test_indefinite_systems_are_solved_and_told(held):
    system, values, b, known = held
    A = _dense(system, values)
    eigenvalues = jnp.linalg.eigvalsh(A)
    shift = (eigenvalues[2] + eigenvalues[3]) / 2  # three below
    mass = jnp.where((system.rows == system.cols) & ~known[system.rows], shift, 0.0)
    factor = system.solver.factor(np.asarray(values - mass))
    exact = jnp.linalg.solve(_dense(system, values - mass), b)
    assert _close(factor.solve(np.asarray(b)), exact, 1e-7)
    assert factor.negative_eigenvalues == 3
    du, negative = factor.step(np.asarray(b))
    assert negative >= 1 and _close(du, exact, 1e-2)
    x, told = sparse.solve_with_inertia(system, values - mass, b)
    assert told == negative and _close(x, du, 1e-6)


def test_the_preconditioner_stays_positive_definite(held):
    system, values, *_ = held
    below = jnp.where(system.rows == system.cols, 0.05, 0.0)
    nodes, dim = OURS.mesh.points.shape
    every = jnp.eye(system.size).reshape(-1, nodes, dim)
    apply = jax.jit(jax.vmap(lambda levels, r: cycle(levels, r).ravel(), (None, 0)))
    for shift in (0.0, 1.0):
        B = apply(multigrid(system.iterative.maps, values - shift * below), every)
        assert _close(B, B.T, 1e-12)
        assert jnp.min(jnp.linalg.eigvalsh(B)) > 0
    assert jnp.min(jnp.linalg.eigvalsh(_dense(system, values - below))) < 0


def test_no_answer_is_taken_for_one(held):
    system, values, b, _ = held
    x, negative = sparse.solve_with_inertia(system, jnp.nan * values, b)
    assert negative == -1 and not jnp.any(x)
    short = sparse.ConjugateGradient(max_iterations=3, coarsest=60)
    problem = _cantilever((12, 4), short)
    with pytest.raises(fem.ConvergenceError, match="conjugate gradients do not converge in 3"):
        fem.solve(problem, max_cuts=1)
    factor = problem.space.system.solver.factor(np.asarray(values))
    with pytest.warns(UserWarning, match="Raise max_iterations"):
        assert np.isnan(factor.solve(np.asarray(b))).all()
    assert factor.step(np.asarray(b)) == (None, -1)


def test_single_precision_ends_at_its_rounding(held):
    system, values, b, _ = held
    few = jnp.float32
    levels = multigrid(system.iterative.maps, values.astype(few))
    found = cg.iterate(levels, b.astype(few), 1e-10, 300)
    exact = jnp.linalg.solve(_dense(system, values), b)
    assert found.x.dtype == few and bool(found.converged)
    assert _close(found.x.astype(float), exact, 1e-3)  # conditioning 1e4 times rounding


def test_iterations_hardly_grow_with_the_mesh():
    counts = []
    for divisions, coarsest in (((12, 4), 60), ((48, 16), 350)):
        problem = _cantilever(divisions, sparse.ConjugateGradient(coarsest=coarsest))
        system, values, b, _ = _matrix(problem)
        assert len(system.iterative.maps.levels) == 1
        levels = multigrid(system.iterative.maps, values)
        counts.append(int(cg.iterate(levels, b, 1e-8, 300).iterations))
    assert counts[1] <= 2 * counts[0] and counts[1] < 40  # Jacobi takes 16 times as many dof


def _tip(problem, shear, pull):
    where = lambda p: (p.material.shear_modulus, p.loads[0].value)  # noqa: E731
    solution = fem.solve(eqx.tree_at(where, problem, (shear, pull)), throw=False, max_cuts=1)
    return jnp.sum(solution.displacement[:, 1]) * 1e3, solution


_slopes = jax.value_and_grad(_tip, (1, 2), has_aux=True)
SHEAR = DIRECT.material.shear_modulus
PULLS = jnp.array([[0.0, 2e3], [1e3, 4e3], [-1e9, 0.0], [2e3, -1e3]])


def test_equilibrium_and_gradient_are_those_of_the_direct_solver():
    (_, ours), slopes = _slopes(OURS, SHEAR, PULLS[1])
    (_, direct), wanted = _slopes(DIRECT, SHEAR, PULLS[1])
    assert _close(ours.displacement, direct.displacement, 1e-9)
    assert ours.stats.iterations == direct.stats.iterations
    for slope, want in zip(slopes, wanted, strict=True):
        assert _close(slope, want, 1e-8)


def test_lanes_in_one_program_that_never_calls_the_host():
    @jax.jit
    def lanes(problem, pulls):
        def one(pull):
            (_, found), slopes = _slopes(problem, SHEAR, pull)
            return found.displacement, found.status == Status.successful, slopes

        return jax.vmap(one)(pulls)

    program = lanes.lower(OURS, PULLS)
    assert "callback" not in program.as_text()
    found, good, slopes = program.compile()(OURS, PULLS)
    assert good.tolist() == [True, True, False, True]
    for lane in (0, 1, 3):
        (_, direct), wanted = _slopes(DIRECT, SHEAR, PULLS[lane])
        assert _close(found[lane], direct.displacement, 1e-9)
        assert _close(slopes[0][lane], wanted[0], 1e-8)
        assert _close(slopes[1][lane], wanted[1], 1e-8)
    assert jnp.isnan(slopes[0][2])


def test_the_solver_is_named_and_strange_ones_are_refused():
    assert "conjugate gradients with multigrid of 2 levels" in repr(OURS)
    assert "factored by" in repr(DIRECT)
    with pytest.raises(ValueError, match="need 'direct', 'conjugate_gradient'"):
        fem.space(OURS.mesh, solver="gauss")
    with pytest.raises(ValueError, match="tolerance"):
        sparse.ConjugateGradient(tolerance=0.0)

    def traced(points):
        grid = dataclasses.replace(OURS.mesh, points=points)
        return fem.space(grid, solver=SETTINGS).cells

    with pytest.raises(ValueError, match="got points traced ones"):
        jax.jit(traced)(OURS.mesh.points)
    assert OURS.space.system.solver.name == "conjugate_gradient"
