"""Symmetric sparse systems: one pattern, many values, direct factors, derivatives.

A system keeps the upper triangle by rows. Its pattern, the slots of the element
matrices in it and the solver's symbolic analysis are computed once; `solve` is
differentiable in the values and in the right-hand side, at the price of one more
back-substitution with the same factor.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import is_traced
from sorojax.math.direct import (
    DirectSolver,
    Factor as Factor,
    available_solvers as available_solvers,
    pattern_key,
    solver_of,
)
from sorojax.math.host_call import host_call


class _Kept:
    """Keeps a solver alive as long as its system. All are equal, so that systems of one
    size share compiled programs."""

    def __init__(self, solver: DirectSolver):
        self.solver = solver

    def __eq__(self, other):
        return isinstance(other, _Kept)

    def __hash__(self):
        return hash(_Kept)


class SparseSymmetric(eqx.Module):
    """Pattern of a symmetric matrix, upper triangle by rows, with its whole diagonal.

    `slots` places the upper triangle of every element matrix, row by row, in the
    values. `key` names the pattern and with it the solver on the host, as data: a program
    compiled for one system serves every other one of the same sizes.
    """

    rows: Int[Array, " nnz"]
    cols: Int[Array, " nnz"]
    slots: Int[Array, "cells entries"]
    key: Int[Array, " 2"]
    size: int = eqx.field(static=True)
    _kept: _Kept = eqx.field(static=True)

    @property
    def num_values(self) -> int:
        return self.rows.shape[0]

    @property
    def solver_name(self) -> str:
        return self._kept.solver.name

    @property
    def solver(self) -> DirectSolver:
        """The solver on the host, for concrete systems.

        Raises:
            ValueError: Inside a trace; use `solve` there.
        """
        if is_traced(self.key):
            raise ValueError(
                "SparseSymmetric.solver: got a traced system, need a concrete one. Use "
                "sparse.solve inside jit and vmap."
            )
        return solver_of(self.key, self.rows, self.cols)


def from_cells(
    num_nodes: int,
    cells: Int[np.ndarray, "cells cell_nodes"],
    components: int = 1,
    more: tuple[Int[np.ndarray, "groups group_nodes"], ...] = (),
) -> SparseSymmetric:
    """The system whose element matrices couple all unknowns of each cell.

    Unknown `components * node + component` belongs to `node`; element matrices are
    ordered in the same way, node by node. `more` makes room for groups of nodes that share
    no cell (`slots_of` finds their places). Runs on the host, once per mesh.
    """
    size = components * num_nodes
    own = _keys(cells, components, size)
    diagonal = np.arange(size, dtype=np.int64) * (size + 1)  # also of unused nodes
    others = [_keys(groups, components, size).ravel() for groups in more]
    keys, inverse = np.unique(
        np.concatenate([own.ravel(), diagonal, *others]), return_inverse=True
    )
    rows, cols = keys // size, keys % size
    rows, cols = rows.astype(np.int32), cols.astype(np.int32)
    key = pattern_key(rows, cols)
    return SparseSymmetric(
        rows=jnp.asarray(rows),
        cols=jnp.asarray(cols),
        slots=jnp.asarray(inverse[: own.size].reshape(own.shape), jnp.int32),
        key=jnp.asarray(key),
        size=size,
        _kept=_Kept(solver_of(key, rows, cols, owned=True)),
    )


def _keys(groups, components: int, size: int) -> Int[np.ndarray, "groups entries"]:
    """Row times size plus column of the upper triangle of every group's matrix."""
    groups = np.asarray(groups, np.int64)
    dofs = (groups[:, :, None] * components + np.arange(components)).reshape(len(groups), -1)
    first, second = np.triu_indices(dofs.shape[1])
    low = np.minimum(dofs[:, first], dofs[:, second])
    return low * size + np.maximum(dofs[:, first], dofs[:, second])


def slots_of(
    system: SparseSymmetric, dofs: Int[np.ndarray, "groups group_dofs"]
) -> Int[Array, "groups entries"]:
    """Slots of the upper triangles of further small matrices inside the pattern.

    Raises:
        ValueError: If a pair of unknowns is not in the pattern.
    """
    wanted = _keys(dofs, 1, system.size)
    keys = np.asarray(system.rows, np.int64) * system.size + np.asarray(system.cols)
    slots = np.searchsorted(keys, wanted)
    if wanted.size and not np.array_equal(keys[np.minimum(slots, len(keys) - 1)], wanted):
        raise ValueError(
            "slots_of: these unknowns have no place in the pattern. Take facets of this mesh, "
            "or name the groups when the pattern is built."
        )
    return jnp.asarray(slots, jnp.int32)


def assemble(
    system: SparseSymmetric, matrices: Float[Array, "cells dofs dofs"]
) -> Float[Array, " nnz"]:
    """Values of the sum of symmetric element matrices."""
    first, second = np.triu_indices(matrices.shape[-1])
    upper = matrices[:, first, second]
    return jnp.zeros(system.num_values, upper.dtype).at[system.slots].add(upper)


@jax.jit
def product(
    system: SparseSymmetric, values: Float[Array, " nnz"], x: Float[Array, " size"]
) -> Float[Array, " size"]:
    """A(values) x."""
    off = jnp.where(system.rows == system.cols, jnp.zeros_like(values), values)
    upper = jnp.zeros_like(x).at[system.rows].add(values * x[system.cols])
    return upper.at[system.cols].add(off * x[system.rows])


def fix(
    system: SparseSymmetric, values: Float[Array, " nnz"], fixed: Array
) -> Float[Array, " nnz"]:
    """Values with the rows and columns where `fixed` is true made those of a scaled
    identity; the scale is the largest diagonal entry, so conditioning is kept."""
    diagonal = system.rows == system.cols
    touched = fixed[system.rows] | fixed[system.cols]
    zero = jnp.zeros_like(values)
    scale = jnp.max(jnp.where(diagonal, jnp.abs(values), zero))
    return jnp.where(touched, jnp.where(diagonal, scale, zero), values)


def solve(
    system: SparseSymmetric, values: Float[Array, " nnz"], b: Float[Array, " size"]
) -> Float[Array, " size"]:
    """x with A(values) x = b by a direct factorisation on the host.

    Differentiable (forward, reverse, twice) in `values` and `b`; under `vmap` all
    right-hand sides of one matrix are solved at once. NaN where A is singular.
    """

    def on_host(_, rhs):
        shape = jax.ShapeDtypeStruct(rhs.shape, rhs.dtype)
        args = (system.key, system.rows, system.cols, values, rhs)
        return host_call(_solve_on_host, (shape,), *args)[0]

    return jax.lax.custom_linear_solve(
        lambda x: product(system, values, x),
        b,
        solve=on_host,
        transpose_solve=on_host,
        symmetric=True,
    )


def solve_with_inertia(
    system: SparseSymmetric, values: Float[Array, " nnz"], b: Float[Array, " size"]
) -> tuple[Float[Array, " size"], Int[Array, ""]]:
    """x with A(values) x = b and the number of negative eigenvalues, -1 if A is singular.

    For loops that decide by the outcome; it has no derivative, `solve` has.
    """
    shapes = (jax.ShapeDtypeStruct(b.shape, b.dtype), jax.ShapeDtypeStruct((), jnp.int32))
    args = (system.key, system.rows, system.cols, values, b)
    x, negative = host_call(_step_on_host, shapes, *args, sequential=True)
    return x, negative


def _solve_on_host(key, rows, cols, values, b) -> tuple[np.ndarray]:
    if key.size == 2:
        return (solver_of(key, rows, cols).solve(values, b),)
    args = (key, rows, cols, values, b)  # lanes with patterns of their own
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in args))
    key, rows, cols, values, b = (np.broadcast_to(x, (*lead, x.shape[-1])) for x in args)
    x = np.empty(b.shape)
    for lane in np.ndindex(*lead):
        x[lane] = solver_of(key[lane], rows[lane], cols[lane]).solve(values[lane], b[lane])
    return (x,)


def _step_on_host(key, rows, cols, values, b) -> tuple:
    return solver_of(key, rows, cols).solve_with_inertia(values, b)
