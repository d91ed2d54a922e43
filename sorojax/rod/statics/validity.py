"""Whether an answer lies within what a rod model describes: not inverted, and resolved."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.math.quadrature import gauss_legendre, interpolation_rows
from sorojax.math.status import Status
from sorojax.rod.dynamics.fields import operators, rest_along
from sorojax.rod.dynamics.tree import rod_motion
from sorojax.rod.model.assembly import slices
from sorojax.rod.model.model import Model
from sorojax.rod.model.rod import Rod, strain_names

_RESOLVED = 1e-3  # of the length: what the quadrature may leave of a rod's tip
_LONGEST = 10.0  # stretch [-]: no solid of a soft robot keeps together beyond


def checked_status(
    status: Status, model: Model, path: Float[Array, "*states coordinates"]
) -> Status:
    """`status`, or what is wrong with an answer that is called successful.

    It is `inverted` where a rod is turned inside out, `outside_model` where it is stretched
    more than tenfold, `unresolved` where twice as many nodes would put its tip elsewhere. Of a
    path the last is looked for at the most strained state alone.

    Args:
        status: Of the search or run.
        model: The rod or assembly.
        path: Coordinates of the answer, or of all saved states.
    """
    model, path = jax.lax.stop_gradient((model, jnp.atleast_2d(path)))
    good = status == Status.successful
    for rod, at in _rods(model):
        own = path[:, at]
        largest = own[jnp.argmax(jnp.sum(own**2, axis=1))] if len(own) > 1 else own[0]
        stretch, least = jax.vmap(lambda q: _stretches(rod, q))(own)  # noqa: B023
        for wrong, found in (
            (~is_resolved(rod, largest), Status.unresolved),
            (jnp.any(stretch > _LONGEST), Status.outside_model),
            (jnp.any(least <= 0), Status.inverted),
        ):
            status = Status.where(good & wrong, found, status)
    return status


def _stretches(rod: Rod, q: Array) -> tuple[Float[Array, " quad"], Float[Array, " quad"]]:
    """Stretch at every node, along the axis and the least at the distance from it that the
    section has in the mean (its radius of gyration)."""
    strain = _strain(rod, q)
    section, zero = rod.section, jnp.zeros((), q.dtype)
    about_y = strain.get("kappa_y", zero) ** 2 * section.second_moment_y
    about_z = strain.get("kappa_z", zero) ** 2 * section.second_moment_z
    bent = jnp.sqrt((about_y + about_z) / section.area)
    return strain["sigma_x"], strain["sigma_x"] - bent


def is_resolved(rod: Rod, q: Float[Array, " dof"]) -> Bool[Array, ""]:
    """Whether twice as many nodes would move the tip by less than a thousandth of the length
    of the rod."""
    distance = _tip(finer(rod), q) - _tip(rod, q)
    return jnp.sum(distance**2) <= (_RESOLVED * rod.length) ** 2


def finer(rod: Rod) -> Rod:
    """The shape of the rod at twice as many nodes; its section and material are means."""
    mean: Any = lambda x: jnp.mean(x, keepdims=False)  # noqa: E731
    section, material = jax.tree.map(mean, (rod.section, rod.material))
    rest, count = rod.rest_strain, 2 * rod.nodes
    twice = Rod(rod.group, rod.basis, section, material, rod.length, None, count, rod.breaks)
    if rest is None or rest.ndim == 1:
        varied = rest
    else:
        nodes, _ = gauss_legendre(twice.quadrature)
        varied = rest @ jnp.asarray(interpolation_rows(rod.quadrature, nodes), rest.dtype).T
    return Rod(rod.group, rod.basis, section, material, rod.length, varied, count, rod.breaks)


def _strain(rod: Rod, q: Array) -> dict[str, Float[Array, " quad"]]:
    constants = operators(rod)
    change = dict(zip(rod.basis.active, constants.strain_rows @ q, strict=True))
    rest = rest_along(constants)
    return {
        name: rest[:, k] + change.get(name, jnp.zeros((), q.dtype))
        for k, name in enumerate(strain_names(rod.group))
    }


def _tip(rod: Rod, q: Array) -> Float[Array, " dim"]:
    moment = rod_motion(rod, q)
    return moment.operators.weights @ moment.tangent


def _rods(model: Model) -> list[tuple[Rod, slice]]:
    """The rods of a model, and where their coordinates are."""
    if isinstance(model, Rod):
        return [(model, slice(None))]
    parts = zip(model.parts, slices(model), strict=True)
    return [(p.body, at.rod_q) for p, at in parts if isinstance(p.body, Rod)]
