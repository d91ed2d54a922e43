"""The sparse door: right answers, derivatives, batches, and factors that know their owner."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math import sparse

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
