"""Banded Cholesky against the dense solution, and which patterns it takes."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh
from sorojax.math.linalg import factor as direct, host_solvers as banded, sparse


def system(nx: int, ny: int) -> sparse.SparseSymmetric:
    grid = mesh.rectangle([0, 0], [nx, ny], divisions=(nx, ny), element=mesh.Quad4())
    return sparse.from_cells(grid.num_nodes, np.asarray(grid.cells), 2)


def pattern(of: sparse.SparseSymmetric):
    rows, cols = np.asarray(of.rows), np.asarray(of.cols)
    return np.searchsorted(rows, np.arange(of.size + 1)), cols


def dense(of: sparse.SparseSymmetric, values) -> np.ndarray:
    upper = np.zeros((of.size, of.size))
    upper[np.asarray(of.rows), np.asarray(of.cols)] = values
    return upper + np.triu(upper, 1).T


def values_of(of: sparse.SparseSymmetric, shift: float) -> np.ndarray:
    values = np.random.default_rng(0).uniform(-1, 1, of.num_values)
    return np.where(np.asarray(of.rows) == np.asarray(of.cols), shift, values)


@pytest.mark.parametrize("mkl", [True, False])
def test_solutions(mkl, monkeypatch):
    if not mkl:
        monkeypatch.setattr(banded, "library", lambda: None)
    given = system(12, 3)
    starts, cols = pattern(given)
    order = banded.narrow_order(starts, cols)
    assert order is not None
    solver = banded.Banded(direct._backend()(starts, cols, 2), order, starts, cols, 2)
    values = values_of(given, 30.0)
    factor = solver.factor(values, 0)
    assert isinstance(factor, banded.BandedFactor) and factor.negative_eigenvalues == 0
    right = np.random.default_rng(1).uniform(-1, 1, (3, given.size))
    want = np.linalg.solve(dense(given, values), right.T).T
    np.testing.assert_allclose(factor.solve(right), want, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(factor.solve(right[0]), want[0], rtol=1e-10, atol=1e-13)


def test_indefinite_matrices_are_counted():
    given = system(12, 3)
    values = values_of(given, 3.0)
    negative = int(np.sum(np.linalg.eigvalsh(dense(given, values)) < 0))
    assert negative > 0
    factor = given.solver.factor(values)
    assert factor is not None and factor.negative_eigenvalues == negative


def test_order_follows_the_body():
    """A band about as wide as a column of nodes, whichever way the mesh was numbered."""
    for nx, ny in ((60, 20), (20, 60)):
        given = system(nx, ny)
        starts, cols = pattern(given)
        order = banded.narrow_order(starts, cols)
        assert order is not None and np.array_equal(np.sort(order), np.arange(given.size))
        place = np.argsort(order)
        rows = np.asarray(given.rows)
        column = 2 * 21
        assert np.abs(place[rows] - place[cols]).max() < 1.2 * column


def test_wide_and_parted_bodies_have_none():
    assert banded.narrow_order(*pattern(system(70, 70))) is None
    parts = sparse.from_cells(6, np.array([[0, 1, 2], [3, 4, 5]]), 1)
    assert banded.narrow_order(*pattern(parts)) is None


def test_a_solver_that_was_asked_for_is_used(monkeypatch):
    monkeypatch.setenv("SOROJAX_SOLVER", "superlu")
    given = system(9, 2)
    values = values_of(given, 30.0)
    assert isinstance(given.solver.factor(values), banded.SuperLUFactor)
    x = sparse.solve(given, jnp.asarray(values), jnp.ones(given.size))
    np.testing.assert_allclose(dense(given, values) @ np.asarray(x), 1.0, rtol=1e-10)
