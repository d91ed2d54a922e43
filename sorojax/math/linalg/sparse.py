"""Symmetric sparse systems: one pattern, many values, two ways to solve, derivatives.

A system keeps the upper triangle by rows. Its pattern, the slots of the element
matrices in it and the solver's symbolic analysis are computed once; `solve` is
differentiable in the values and in the right-hand side, at the price of one more
back-substitution with the same factor. Factors are made on the host; conjugate gradients
with multigrid stay in the program, and with it on an accelerator.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.host_call import host_call
from sorojax._jax.trace_state import is_traced
from sorojax._types import from_host
from sorojax.math.linalg import conjugate_gradient as cg
from sorojax.math.linalg.conjugate_gradient import (
    ConjugateGradient as ConjugateGradient,
    IterativeFactor as IterativeFactor,
)
from sorojax.math.linalg.factor import (
    DirectSolver,
    Factor as Factor,
    available_solvers as available_solvers,
    direct_solver_of,
    pattern_key,
    solver_of,
)
from sorojax.math.linalg.multigrid import hierarchy


class _Kept:
    """Keeps a solver alive as long as its system. All are equal, so that systems of one
    size share compiled programs."""

    def __init__(self, solver: DirectSolver):
        self.solver = solver

    def __eq__(self, other):
        return isinstance(other, _Kept)

    def __hash__(self):
        return hash(_Kept)

    def __deepcopy__(self, memo):
        return self

    def __reduce__(self):
        """Pattern and key: another process analyses them again."""
        return _kept_again, (*self.solver.recipe, _double())


def _double() -> bool:
    return bool(jax.config.read("jax_enable_x64"))


def _kept_again(key, starts, cols, iterative: cg.Iterative | None, double: bool) -> _Kept:
    if double and not _double():
        raise ValueError(
            "unpickling: this process has single precision, need double as where it was "
            "pickled, or its arrays lose digits. Set JAX_ENABLE_X64=1 for workers as well."
        )
    rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return _Kept(_solver_of(key, rows, cols, iterative, owned=True))


class SparseSymmetric(eqx.Module):
    """Pattern of a symmetric matrix, upper triangle by rows, with its whole diagonal.

    `slots` places the upper triangle of every element matrix, row by row, in the
    values. `key` names the pattern and with it the solver on the host, as data: a program
    compiled for one system serves every other one of the same sizes. `iterative` is there
    where systems are solved by iteration.
    """

    rows: Int[Array, " nnz"]
    cols: Int[Array, " nnz"]
    slots: Int[Array, "cells entries"]
    key: Int[Array, " 2"]
    iterative: cg.Iterative | None
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
        return _solver_of(self.key, self.rows, self.cols, self.iterative)

    @property
    def means(self) -> str:
        """How systems are solved, in words."""
        if self.iterative is None:
            return f"factored by {self.solver_name}"
        levels = len(self.iterative.maps.levels) + 1
        return f"solved by conjugate gradients with multigrid of {levels} levels"

    @property
    def unsolved(self) -> str:
        """The error message for a system without a solution."""
        if self.iterative is None:
            return "the tangent is singular"
        most = self.iterative.settings.max_iterations
        return f"conjugate gradients do not converge in {most} iterations"


def from_cells(
    num_nodes: int,
    cells: Int[np.ndarray, "cells cell_nodes"],
    components: int = 1,
    more: tuple[Int[np.ndarray, "groups group_nodes"], ...] = (),
    solver: ConjugateGradient | None = None,
    points: Float[Array | np.ndarray, "nodes components"] | None = None,
) -> SparseSymmetric:
    """The system whose element matrices couple all unknowns of each cell.

    Unknown `components * node + component` belongs to `node`; element matrices are
    ordered in the same way, node by node. `more` makes room for groups of nodes that share
    no cell (`slots_of` finds their places). Without a `solver` matrices are factored; with
    one the unknowns are displacements of nodes at `points` [m], whose rigid motions the
    preconditioner knows. Runs on the host, once per mesh.
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
    iterative, key = None, pattern_key(rows, cols)
    if solver is not None:
        maps = hierarchy(_placed(points, num_nodes, components), rows, cols, solver.coarsest)
        iterative = cg.Iterative(solver, maps)
        key = pattern_key(rows, cols, (solver, points))
    return SparseSymmetric(
        rows=from_host(rows),
        cols=from_host(cols),
        slots=from_host(inverse[: own.size].reshape(own.shape), jnp.int32),
        key=from_host(key),
        iterative=iterative,
        size=size,
        _kept=_Kept(_solver_of(key, rows, cols, iterative, owned=True)),
    )


def from_pattern(
    rows: Int[Array, "*lanes nnz"],
    cols: Int[Array, "*lanes nnz"],
    slots: Int[Array, "*lanes cells entries"],
    key: Int[Array, "*lanes 2"],
    iterative: cg.Iterative | None,
    size: int,
) -> SparseSymmetric:
    """The system of a pattern from a file, with a solver of this machine and its key.

    Raises:
        ValueError: If the pattern is not an upper triangle by rows with its whole diagonal.
    """
    if not (isinstance(size, int) and size > 0 and isinstance(iterative, cg.Iterative | None)):
        raise ValueError(f"a system of {size} unknowns and {type(iterative).__name__}")
    lead, keys = np.shape(rows)[:-1], []
    fits = np.shape(rows) == np.shape(cols) and np.shape(key) == (*lead, 2)
    if not fits or 0 in np.shape(rows) or np.ndim(slots) < 2:
        raise ValueError(f"rows {np.shape(rows)}, columns {np.shape(cols)}")
    for i, k in zip(
        *(np.asarray(x).reshape(-1, x.shape[-1]) for x in (rows, cols)), strict=True
    ):
        place = i.astype(np.int64) * size + k
        inside = i.dtype == k.dtype == np.int32 and np.all((i >= 0) & (i <= k) & (k < size))
        if not inside or np.any(np.diff(place) <= 0) or np.sum(i == k) != size:
            raise ValueError("rows and columns are no upper triangle by rows with its diagonal")
        more = (
            () if iterative is None else (iterative.settings, *jax.tree.leaves(iterative.maps))
        )
        keys.append(pattern_key(i, k, more))
    starts = np.searchsorted(i, np.arange(size + 1))
    return SparseSymmetric(
        rows,
        cols,
        slots,
        from_host(np.stack(keys).reshape(key.shape)),
        iterative,
        size,
        _kept_again(keys[-1], starts, k, iterative, _double()),
    )


def _placed(points, num_nodes: int, components: int) -> Float[np.ndarray, "nodes components"]:
    if points is None or is_traced(points) or np.shape(points) != (num_nodes, components):
        got = "none" if points is None else f"those of shape {np.shape(points)}"
        got = "traced ones" if is_traced(points) else got
        raise ValueError(
            f"from_cells: got points {got}, need concrete ones of shape ({num_nodes}, "
            f"{components}) for the multigrid of ConjugateGradient. Build the system outside "
            "jit and grad, and replace only the points of the mesh inside."
        )
    return np.asarray(points)


def _solver_of(
    key, rows, cols, iterative: cg.Iterative | None, owned: bool = False
) -> DirectSolver:
    if iterative is None:
        return direct_solver_of(key, rows, cols, owned)
    return solver_of(key, rows, cols, lambda *_: cg.IterativeBackend(iterative), owned)


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
    return from_host(slots, jnp.int32)


@jax.jit
def assemble(
    system: SparseSymmetric, matrices: Float[Array, "cells dofs dofs"]
) -> Float[Array, " nnz"]:
    """Values of the sum of symmetric element matrices."""
    first, second = np.triu_indices(matrices.shape[-1])
    upper = matrices[:, first, second]
    return jnp.zeros(system.num_values, upper.dtype).at[system.slots].add(upper)


def assembled_on_host(
    system: SparseSymmetric, matrices: Float[np.ndarray, "cells dofs dofs"]
) -> Float[np.ndarray, " nnz"]:
    """The values of `assemble` by NumPy, without a program: for what is made on the host."""
    first, second = np.triu_indices(matrices.shape[-1])
    upper, slots = matrices[:, first, second], np.asarray(system.slots)
    return np.bincount(slots.ravel(), upper.ravel(), minlength=system.num_values)


@jax.jit
def product(
    system: SparseSymmetric, values: Float[Array, " nnz"], x: Float[Array, " size"]
) -> Float[Array, " size"]:
    """A(values) x."""
    off = jnp.where(system.rows == system.cols, jnp.zeros_like(values), values)
    upper = jnp.zeros_like(x).at[system.rows].add(values * x[system.cols])
    return upper.at[system.cols].add(off * x[system.rows])


@jax.jit
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


def fixed_on_host(
    system: SparseSymmetric, values: np.ndarray, fixed: np.ndarray
) -> Float[np.ndarray, " nnz"]:
    """The bits of `fix` without a program, for what stays on the host."""
    rows, cols = np.asarray(system.rows), np.asarray(system.cols)
    diagonal, touched = rows == cols, fixed[rows] | fixed[cols]
    held = np.where(touched, 0.0, values)
    held[diagonal & touched] = np.max(np.abs(values[diagonal]))
    return held


def solve(
    system: SparseSymmetric, values: Float[Array, " nnz"], b: Float[Array, " size"]
) -> Float[Array, " size"]:
    """x with A(values) x = b by a direct factorisation on the host, or by iteration.

    Differentiable (forward, reverse, twice) in `values` and `b`; under `vmap` all
    right-hand sides of one matrix are solved at once. NaN where A is singular, or where
    the iteration does not converge.
    """
    if system.iterative is not None:
        return cg.solve(system.iterative, lambda x: product(system, values, x), values, b)

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

    An iterative solver stops at the accuracy of a Newton step, counts the negative
    eigenvalues that it met, and gives -1 where it does not converge. For loops that decide
    by the outcome; it has no derivative, `solve` has.
    """
    if system.iterative is not None:
        return cg.newton_step(system.iterative, values, b)
    shapes = (jax.ShapeDtypeStruct(b.shape, b.dtype), jax.ShapeDtypeStruct((), jnp.int32))
    args = (system.key, system.rows, system.cols, values, b)
    x, negative = host_call(_step_on_host, shapes, *args, sequential=True)
    return x, negative


def _solve_on_host(key, rows, cols, values, b) -> tuple[np.ndarray]:
    if key.size == 2:
        return (direct_solver_of(key, rows, cols).solve(values, b),)
    args = (key, rows, cols, values, b)  # lanes with patterns of their own
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in args))
    key, rows, cols, values, b = (np.broadcast_to(x, (*lead, x.shape[-1])) for x in args)
    x = np.empty(b.shape)
    for lane in np.ndindex(*lead):
        solver = direct_solver_of(key[lane], rows[lane], cols[lane])
        x[lane] = solver.solve(values[lane], b[lane])
    return (x,)


def _step_on_host(key, rows, cols, values, b) -> tuple:
    return direct_solver_of(key, rows, cols).solve_with_inertia(values, b)
