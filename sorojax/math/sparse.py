"""Symmetric sparse systems: one pattern, many values, direct factors, derivatives.

A system keeps the upper triangle by rows. Its pattern, the slots of the element
matrices in it and the solver's symbolic analysis are computed once; `solve` is
differentiable in the values and in the right-hand side, at the price of one more
back-substitution with the same factor.
"""

import os
from collections import OrderedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.math import pardiso, superlu

_NUM_FACTORS = 4
Factor = pardiso.PardisoFactor | superlu.SuperLUFactor


def available_solvers() -> dict[str, str]:
    """Direct solvers found on this machine, best first, with their versions."""
    import scipy

    mkl = pardiso.version()
    found = {"pardiso": f"MKL {mkl}"} if mkl else {}
    return found | {"superlu": f"SciPy {scipy.__version__}"}


def _backend():
    asked = os.environ.get("SOROJAX_SOLVER", "")
    if asked not in ("", "pardiso", "superlu"):
        raise ValueError(
            f"SOROJAX_SOLVER is {asked!r}, need 'pardiso' or 'superlu'. Unset it for the "
            "best solver found."
        )
    if asked != "superlu" and pardiso.library() is not None:
        return pardiso.Pardiso
    if asked == "pardiso":
        raise ValueError("SOROJAX_SOLVER is 'pardiso': install sorojax[pardiso] first.")
    return superlu.SuperLU


class DirectSolver:
    """Host side of a system: symbolic analysis and the last few numeric factors.

    A slot records the values that its factor belongs to, so that a factor is never
    used for other values than its own.
    """

    def __init__(self, indptr: np.ndarray, indices: np.ndarray):
        self._solver = _backend()(indptr, indices, _NUM_FACTORS)
        self._slots: OrderedDict[int, tuple[np.ndarray, Factor]] = OrderedDict()
        self.num_factorisations = 0

    @property
    def name(self) -> str:
        return self._solver.name

    def factor(self, values: np.ndarray) -> Factor | None:
        """Factor of `values`, reused if a slot holds it; `None` if singular."""
        values = np.asarray(values)
        for slot, (owner, factor) in self._slots.items():
            if owner is values or np.array_equal(owner, values):
                self._slots.move_to_end(slot)
                return factor
        if not np.all(np.isfinite(values)):
            return None
        slot = len(self._slots)
        if slot == _NUM_FACTORS:
            slot, _ = self._slots.popitem(last=False)
        factor = self._solver.factor(values, slot)
        self.num_factorisations += 1
        if factor is not None:
            self._slots[slot] = (values.copy(), factor)
        else:  # keep the slot's number in circulation
            self._slots[slot] = (np.full(1, np.nan), factor)  # type: ignore[arg-type]
            self._slots.move_to_end(slot, last=False)
        return factor

    def solve(self, values: np.ndarray, b: np.ndarray) -> np.ndarray:
        """x with A(values) x = b for any leading batch axes; NaN where singular."""
        values, b = np.asarray(values), np.asarray(b)
        lead = np.broadcast_shapes(values.shape[:-1], b.shape[:-1])
        if values.ndim == 1 or values.size == values.shape[-1]:
            return self._solve_many(values.reshape(-1), b, lead)
        values = np.broadcast_to(values, (*lead, values.shape[-1]))
        b = np.broadcast_to(b, (*lead, b.shape[-1]))
        x = np.empty(b.shape)
        for index in np.ndindex(*lead):
            x[index] = self._solve_many(values[index], b[index], ())
        return x

    def solve_with_inertia(self, values: np.ndarray, b: np.ndarray) -> tuple:
        """x with A(values) x = b, and how many eigenvalues are negative: -1 and zeros where
        A is singular, so that a failed step stays finite."""
        factor = self.factor(values)
        if factor is None:
            return np.zeros(b.shape), np.int32(-1)
        return factor.solve(np.asarray(b)), np.int32(max(factor.negative_eigenvalues, 0))

    def _solve_many(self, values, b, lead) -> np.ndarray:
        factor = self.factor(values)
        if factor is None:
            return np.full((*lead, b.shape[-1]), np.nan)
        rhs = b.reshape(-1, b.shape[-1])
        x = factor.solve(rhs[0])[None] if len(rhs) == 1 else factor.solve(rhs)
        return np.broadcast_to(x.reshape(b.shape), (*lead, b.shape[-1]))


class SparseSymmetric(eqx.Module):
    """Pattern of a symmetric matrix, upper triangle by rows.

    `slots` places the upper triangle of every element matrix, row by row, in the
    values. `solver` is host state; it is compared by identity.
    """

    rows: Int[Array, " nnz"]
    cols: Int[Array, " nnz"]
    slots: Int[Array, "cells entries"]
    size: int = eqx.field(static=True)
    solver: DirectSolver = eqx.field(static=True)

    @property
    def num_values(self) -> int:
        return self.rows.shape[0]


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
    indptr = np.searchsorted(rows, np.arange(size + 1))
    return SparseSymmetric(
        rows=jnp.asarray(rows, jnp.int32),
        cols=jnp.asarray(cols, jnp.int32),
        slots=jnp.asarray(inverse[: own.size].reshape(own.shape), jnp.int32),
        size=size,
        solver=DirectSolver(indptr, cols),
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
        return jax.pure_callback(
            system.solver.solve,
            jax.ShapeDtypeStruct(rhs.shape, rhs.dtype),
            values,
            rhs,
            vmap_method="expand_dims",
        )

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
    return jax.pure_callback(
        system.solver.solve_with_inertia, shapes, values, b, vmap_method="sequential"
    )
