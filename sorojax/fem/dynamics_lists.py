"""Lists of near facets that follow a motion, on the host."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.contact_steps import updated
from sorojax.fem.problem import Problem
from sorojax.fem.self_contact import SelfContact, with_partners

_SHARE = 0.25  # of the reach, that points may move before lists are made anew

Nodal = Float[Array, "nodes dim"]


def has_lists(problem: Problem) -> bool:
    """Whether facets of the problem look for each other."""
    return any(isinstance(load, SelfContact) for load in problem.loads)


def listed_at(problem: Problem, now: Nodal, listed: Nodal | None) -> tuple[Problem, Nodal]:
    """`problem` with lists that hold at displacement `now` [m], and the displacement that
    they were made at: `listed` as long as no facet has moved much from there."""
    if listed is not None and not _outdated(problem, np.asarray(now - listed)):
        return problem, listed
    return updated(problem, now), now


def _outdated(problem: Problem, moved: np.ndarray) -> bool:
    """Whether facets moved by a share of the reach: a partner, or any against the mean."""
    for load in problem.loads:
        if isinstance(load, SelfContact):
            own = moved[load.rows(np)].mean(axis=1)
            apart = own[np.asarray(load.partners)] - own[:, None]
            spread = own - own.mean(axis=0)
            drift = max((apart**2).sum(axis=2).max(initial=0.0), (spread**2).sum(axis=1).max())
            if drift > (_SHARE * float(load.reach)) ** 2:  # type: ignore[arg-type]
                return True
    return False


def lists_of(problem: Problem, displacements: Float[Array, "times nodes dim"]) -> tuple:
    """Partners of the facets of each load at every time, `None` for loads without."""
    found = []
    for load in problem.loads:
        if not isinstance(load, SelfContact):
            found.append(None)
            continue
        rows = [with_partners(load, problem.mesh, np.asarray(u)) for u in displacements]
        partners = jnp.stack([row.partners for row in rows])  # type: ignore[arg-type]
        found.append((partners, jnp.stack([row.real for row in rows])))  # type: ignore
    return tuple(found)


def with_lists(loads: tuple, lists: tuple) -> tuple:
    """`loads` with partners of one time."""
    return tuple(
        load if row is None else dataclasses.replace(load, partners=row[0], real=row[1])
        for load, row in zip(loads, lists, strict=True)
    )


@eqx.filter_jit
def longest_share(problem: Problem, du: Nodal) -> Float[Array, ""]:
    """Share of a Newton step [m] after which every load still sees what it acts on."""
    shares = [load.longest_share(du) for load in problem.loads]
    return jax.tree.reduce(jnp.minimum, shares, jnp.ones((), du.dtype))
