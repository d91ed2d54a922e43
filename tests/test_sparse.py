"""The sparse door: right answers, derivatives, batches, and factors that know their owner."""

import gc
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.linalg import sparse

CELLS = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4]])


def _system(getkey):
    system = sparse.from_cells(5, CELLS, components=2)
    M = jax.random.normal(getkey(), (3, 6, 6))
    values = sparse.assemble(system, M @ jnp.swapaxes(M, 1, 2) + jnp.eye(6)[None])
    return system, values, jax.random.normal(getkey(), (10,))


def _dense(system, values):
    A = jnp.zeros((10, 10)).at[system.rows, system.cols].set(values)
    return A + jnp.triu(A, 1).T


@pytest.mark.parametrize("backend", sorted(sparse.available_solvers()))
def test_every_solver_gives_the_dense_answer_and_its_derivatives(backend, getkey, monkeypatch):
    monkeypatch.setenv("SOROJAX_SOLVER", backend)
    system, values, b = _system(getkey)
    assert system.solver.name == backend

    def cost(values, b):
        return jnp.sum(sparse.solve(system, values, b) ** 3)

    def dense_cost(values, b):
        return jnp.sum(jnp.linalg.solve(_dense(system, values), b) ** 3)

    ours = jax.value_and_grad(cost, (0, 1))(values, b)
    exact = jax.value_and_grad(dense_cost, (0, 1))(values, b)
    for a, e in zip(jax.tree.leaves(ours), jax.tree.leaves(exact), strict=True):
        assert jnp.allclose(a, e, rtol=1e-9, atol=1e-12)
    second = jax.jit(jax.hessian(cost, 1))(values, b)
    assert jnp.allclose(second, jax.hessian(dense_cost, 1)(values, b), rtol=1e-8, atol=1e-12)


def test_a_batch_larger_than_the_factor_slots_keeps_every_gradient(getkey):
    system, values, b = _system(getkey)
    scales = jnp.linspace(1.0, 3.0, 9)

    def cost(scale):
        return jnp.sum(sparse.solve(system, scale * values, b))

    batched = jax.vmap(jax.grad(cost))(scales)
    alone = jnp.stack([jax.grad(cost)(s) for s in scales])
    assert jnp.allclose(batched, alone, rtol=1e-12)
    assert jnp.allclose(alone, -cost(jnp.array(1.0)) / scales**2, rtol=1e-10)


def test_one_factorisation_serves_a_value_and_its_gradient(getkey):
    system, values, b = _system(getkey)
    values = 1.75 * values  # equal patterns share a solver, and it keeps its last factors
    before = system.solver.num_factorisations
    jax.value_and_grad(lambda b: jnp.sum(sparse.solve(system, values, b)))(b)
    assert system.solver.num_factorisations == before + 1


def test_inertia_counts_negative_eigenvalues(getkey):
    system, values, b = _system(getkey)
    shift = jnp.where(system.rows == system.cols, 6.0, 0.0)
    factor = system.solver.factor(np.asarray(values - shift))
    exact = np.linalg.eigvalsh(np.asarray(_dense(system, values - shift)))
    assert factor.negative_eigenvalues == np.sum(exact < 0) > 0


def test_a_singular_matrix_gives_nan_and_not_a_number(getkey):
    system, values, b = _system(getkey)
    assert jnp.isnan(sparse.solve(system, 0 * values, b)).all()


def test_product_and_fixed_rows(getkey):
    system, values, b = _system(getkey)
    assert jnp.allclose(sparse.product(system, values, b), _dense(system, values) @ b)
    known = jnp.zeros(10, bool).at[jnp.array([0, 7])].set(True)
    fixed = _dense(system, sparse.fix(system, values, known))
    assert jnp.allclose(fixed[0, 1:], 0) and fixed[0, 0] > 0 and jnp.allclose(fixed[:7, 7], 0)


def test_strange_facets_are_refused(getkey):
    system, _, _ = _system(getkey)
    with pytest.raises(ValueError, match="no place in the pattern"):
        sparse.slots_of(system, np.array([[0, 9]]))


def test_a_program_outlives_the_system_it_was_compiled_for(getkey):
    first, values, b = _system(getkey)
    other = sparse.from_cells(5, CELLS[::-1], components=2)
    assert np.array_equal(first.key, other.key)  # equal patterns share one solver
    shuffled = sparse.from_cells(5, np.array([[0, 1, 3], [1, 3, 2], [3, 2, 4]]), components=2)
    assert shuffled.num_values == first.num_values
    assert not np.array_equal(first.key, shuffled.key)

    @jax.jit
    def solved(system, values, b):
        return system, sparse.solve(system, values, b)

    _, x = solved(first, values, b)
    shuffled_values = jnp.asarray(np.where(shuffled.rows == shuffled.cols, 9.0, 1.0))
    want = jnp.linalg.solve(_dense(shuffled, shuffled_values), b)
    copy, y = solved(shuffled, shuffled_values, b)
    assert solved._cache_size() == 1
    assert jnp.allclose(y, want) and jnp.allclose(_dense(first, values) @ x, b)
    del shuffled
    gc.collect()
    assert jnp.allclose(solved(copy, shuffled_values, b)[1], want)
    assert copy.solver.num_factorisations > 0


def test_lanes_may_have_patterns_of_their_own(getkey):
    first, values, b = _system(getkey)
    second = sparse.from_cells(5, np.array([[0, 1, 3], [1, 3, 2], [3, 2, 4]]), components=2)
    both = jax.tree.map(lambda x, y: jnp.stack([x, y]), first, second)
    simple = jnp.where(second.rows == second.cols, 9.0, 1.0)
    x = jax.jit(jax.vmap(sparse.solve, (0, 0, None)))(both, jnp.stack([values, simple]), b)
    assert jnp.allclose(_dense(first, values) @ x[0], b)
    assert jnp.allclose(_dense(second, simple) @ x[1], b)


_ONE_CORE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from sorojax.math.linalg import sparse
n = 100_000
system = sparse.from_cells(n, np.stack([np.arange(n - 1), np.arange(1, n)], 1))
values = jnp.where(system.rows == system.cols, 3.0, -1.0)

@jax.jit
def steps(values, b):
    two = sparse.solve(system, values, b) + sparse.solve(system, 2 * values, b[::-1])
    return jax.lax.fori_loop(0, 3, lambda _, x: sparse.solve(system, values, x), two)

starts = [steps(values, jnp.ones(n) + k) for k in range(4)]
print(float(sum(jnp.max(x) for x in starts)))
"""


def test_solves_in_programs_under_way_on_one_core_end():
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system cannot hold a process to one core")
    done = subprocess.run(
        [sys.executable, "-c", _ONE_CORE], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert np.isclose(float(done.stdout), 1.5 * (1 + 2 + 3 + 4), rtol=1e-3)
