"""Systems solved by the factor of a neighbouring one."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh
from sorojax.math.linalg import sparse
from sorojax.math.linalg.factor import refined

GRID = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(6, 6), element=mesh.Quad4())
SYSTEM = sparse.from_cells(GRID.num_nodes, np.asarray(GRID.cells))
RANDOM = np.random.default_rng(0)
MATRICES = RANDOM.standard_normal((36, 4, 4))
SPREAD = RANDOM.standard_normal((36, 4, 4))
RIGHT = RANDOM.standard_normal(SYSTEM.size)


def values(spread):
    """Of a positive definite matrix for a small `spread`, of another one for each."""
    cells = MATRICES @ MATRICES.swapaxes(1, 2) + np.eye(4) + spread * (SPREAD + SPREAD.mT)
    return np.asarray(sparse.assemble(SYSTEM, jnp.asarray(cells)))


@pytest.mark.parametrize(("spread", "new"), [(0.0, 0), (1e-9, 0), (1e-4, 0), (0.3, 1)])
def test_a_near_factor_gives_the_digits_of_its_own(spread, new):
    solver = SYSTEM.solver
    solver.factor(values(10.0))  # far away, and the last one
    solver.factor(values(0.0))
    solver.factor(values(20.0))
    before = solver.num_factorisations
    x = solver.solve_near(values(spread), RIGHT)
    assert solver.num_factorisations == before + new
    want = solver.solve(values(spread), RIGHT)
    assert np.allclose(x, want, rtol=0, atol=1e-11 * np.abs(want).max())
    left = sparse.product(SYSTEM, jnp.asarray(values(spread)), jnp.asarray(x))
    assert np.allclose(left, RIGHT, atol=1e-11)


def test_a_factor_that_is_none_is_found_out():
    class Nothing:
        def solve(self, b):
            return np.full_like(b, np.nan)

    class Half:
        def solve(self, b):
            return b / 2

    assert refined(Nothing(), lambda x: x, RIGHT) is None
    assert refined(Half(), lambda x: np.linspace(0.1, 2.0, len(x)) * x, RIGHT) is None


class Diagonal:
    def __init__(self, values):
        self.values = values

    def solve(self, b):
        return b / self.values


@pytest.mark.parametrize("turned", [-0.01, -0.2])
def test_a_neighbour_that_is_not_positive_definite_is_found_out(turned):
    known = np.linspace(1.0, 100.0, 60)
    near = known * (1 + 0.02 * RANDOM.uniform(-1, 1, 60))
    right = RANDOM.standard_normal(60)
    x = refined(Diagonal(known), lambda x: near * x, right)
    assert x is not None and np.allclose(near * x, right, rtol=0, atol=1e-10)
    near[7] = turned * known[7]
    right[7] = 0.0  # the load does not push that way
    start = 0.1 * RANDOM.standard_normal(60)
    assert refined(Diagonal(known), lambda x: near * x, right, start) is None
    guess = np.where(np.arange(60) == 7, 0.0, start)
    x = refined(Diagonal(known), lambda x: near * x, right, guess)
    assert x is not None and np.allclose(near * x, right, rtol=0, atol=1e-10)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-6])
def test_a_step_is_solved_to_what_is_asked_for(tolerance):
    known = np.linspace(1.0, 100.0, 60)
    near, asked = known * (1 + 0.1 * RANDOM.uniform(-1, 1, 60)), []

    class Counted(Diagonal):
        def solve(self, b):
            asked.append(1)
            return super().solve(b)

    right = RANDOM.standard_normal(60)
    x = refined(Counted(known), lambda x: near * x, right, tolerance=tolerance)
    want = right / near
    assert x is not None and np.abs(x - want).max() <= tolerance * np.abs(want).max()
    assert len(asked) <= (3 if tolerance == 1e-2 else 6)


def test_supports_on_the_host_have_the_bits_of_the_program():
    fixed = RANDOM.uniform(size=SYSTEM.size) < 0.3
    want = sparse.fix(SYSTEM, jnp.asarray(values(0.1)), jnp.asarray(fixed))
    assert np.array_equal(sparse.fixed_on_host(SYSTEM, values(0.1), fixed), want)
