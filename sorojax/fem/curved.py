"""Load stiffness: small dense matrices of groups of nodes, scattered into the tangent."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_BLOCK = 32  # groups that are skipped together


class CurvedPart(NamedTuple):
    """Groups of nodes, and the energy [J] of one at its deformed positions [m].

    `energy(x, data)` takes the positions of a group and its row of `data`. Where
    `idle(x, data)` holds for a block of groups its stiffness is known to be zero and is
    not computed.
    """

    groups: Int[Array, "groups group_nodes"]
    energy: Callable[[Float[Array, "group_nodes dim"], Any], Float[Array, ""]]
    data: Any = None
    idle: Callable[[Float[Array, "block group_nodes dim"], Any], Bool[Array, ""]] | None = None


def group_matrices(
    part: CurvedPart, x: Float[Array, "groups group_nodes dim"]
) -> Float[Array, "groups entries"]:
    """Upper triangles of the second derivatives, node by node [N/m].

    Where a node stands twice in a group, the entry between the two is one of the diagonal
    and counts twice.
    """
    size, dim = x.shape[1] * x.shape[2], x.shape[2]
    first, second = np.triu_indices(size)
    twin = (first != second) & (first % dim == second % dim)
    repeated = part.groups[:, first // dim] == part.groups[:, second // dim]
    count = jnp.where(repeated & jnp.asarray(twin)[None], 2.0, 1.0).astype(x.dtype)

    def upper(x, data):
        def energy(flat):
            return part.energy(flat.reshape(x.shape), data)

        return jax.hessian(energy)(x.ravel())[first, second]

    def many(x, data):
        return jax.vmap(upper)(x, data)

    if part.idle is None:
        return count * many(x, part.data)
    return count * blockwise(many, part.idle, x, part.data, (len(first),))


@eqx.filter_custom_jvp
def group_energy(
    x: Float[Array, "groups group_nodes dim"], load: Any, problem: Any
) -> Float[Array, ""]:
    """Energy [J] of the groups of `load` at positions `x` [m].

    Of groups that are idle neither the energy nor its slope is computed.
    """
    return _summed(x, load, problem)


def _summed(x, load, problem):
    part = load.curved_part(problem)
    return jnp.sum(blockwise(jax.vmap(part.energy), part.idle, x, part.data, ()))


@group_energy.def_jvp
def _group_slope(primals, tangents):
    if jax.tree.leaves(tangents[1:]):
        return eqx.filter_jvp(_summed, primals, tangents)
    x, load, problem = primals
    part = load.curved_part(problem)
    slope = jax.vmap(jax.grad(part.energy))
    found = blockwise(slope, part.idle, x, part.data, x.shape[1:])
    return group_energy(x, load, problem), jnp.sum(found * tangents[0])


def blockwise(
    kernel: Callable,
    idle: Callable,
    x: Float[Array, "groups ..."],
    data: Any,
    tail: tuple,
    rest: Callable | None = None,
) -> Float[Array, "groups ..."]:
    """`kernel(x, data)` in blocks of groups; where a block is idle `rest(x, data)`, or zeros
    of shape `tail`."""
    count = x.shape[0]
    width = min(_BLOCK, count)
    num_blocks = -(-count // width)
    # the last block is filled up with copies of the last group
    at = jnp.minimum(jnp.arange(num_blocks * width), count - 1).reshape(num_blocks, width)

    rows = jax.tree.map(lambda leaf: leaf[at], (x, data))
    still = jax.vmap(idle)(*rows)

    def nothing(*_):
        return jnp.zeros((width, *tail), x.dtype)

    def block(row):
        return jax.lax.cond(row[0], rest or nothing, kernel, *row[1])

    # a loop that finds every block idle costs more than all that it finds
    found = jax.lax.cond(
        jnp.all(still),
        lambda: jax.vmap(rest or nothing)(*rows),
        lambda: jax.lax.map(block, (still, rows)),
    )
    return found.reshape(num_blocks * width, *tail)[:count]
