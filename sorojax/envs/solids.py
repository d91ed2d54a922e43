"""What environments of reduced solids share: their training, which is kept on the computer,
their rubber, their motion, and their rest."""

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _cache, io
from sorojax.math.compiled import chunked_lanes
from sorojax.systems.blocks import (
    modal_basis,
    modal_body,
    sampled_body,
    sampled_force,
    surface_contact,
)
from sorojax.systems.blocks.modal_body import ModalBody
from sorojax.systems.blocks.sampled_force import SampledForce

_SETTLING = (0.05, 40, 20)  # [s], steps, and how many of them raise the pressures
_LANES = 4  # members at once on a CPU, whose cache holds what they need


_TRAINING = modal_basis, modal_body, sampled_body, sampled_force, surface_contact


def kept(
    where: str,
    settings: tuple[float, ...],
    source: Path,
    train: Callable[..., Any],
    keep: bool = True,
) -> Any:
    """What `train(*settings)` makes, read from `$SOROJAX_CACHE/trained` if it was kept there by
    an earlier call. It is known by the settings, the version, and the text of what trains,
    that of the file `source` included.

    Trained and kept in double precision always; given in that of the process.
    """
    double = jax.config.jax_enable_x64  # pyright: ignore
    with jax.enable_x64(True):
        made = _trained(where, settings, source, train, keep)
        return made if double else jax.tree.map(_narrowed, made)


def _trained(
    where: str,
    settings: tuple[float, ...],
    source: Path,
    train: Callable[..., Any],
    keep: bool,
) -> Any:
    if not keep:
        return train(*settings)
    from sorojax import __version__

    told = repr([float(x) for x in settings]) + __version__ + source.read_text()
    text = told + "".join(inspect.getsource(part) for part in _TRAINING)
    name = hashlib.sha256(text.encode()).hexdigest()[:24]
    path = _cache.trained_directory() / f"{where}-{name}.npz"
    if path.exists():
        try:
            return io.load(path)
        except ValueError:  # damaged, or of other classes: train again
            pass
    made = train(*settings)
    io.save(path, made)
    return made


def _narrowed(leaf: Any) -> Any:
    return leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf


class SolidBody(NamedTuple):
    """Coordinates of a reduced solid and their rates."""

    q: Float[Array, " modes"]
    v: Float[Array, " modes"]


class Rubber(NamedTuple):
    """Factors of stiffness, viscosity and density, over those of the training [-]."""

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    density: Float[Array, ""]


class Solid(NamedTuple):
    """A reduced body of another rubber than that of its training.

    Attributes:
        body: With the forces of that rubber.
        mass: Of each coordinate, in that of the training [-].
    """

    body: ModalBody
    mass: Float[Array, ""]


def of_rubber(body: ModalBody, rubber: Rubber) -> Solid:
    """The body of `sampled_body`, which is loaded by its weight and by what is driven alone,
    in another rubber: exactly, as shapes and cells are the same."""
    force = body.force
    assert isinstance(force, SampledForce)
    parts = [force.volumes * rubber.stiffness]
    parts += [rubber.density * term for term in force.loads.terms]
    where = [lambda b: b.force.volumes, lambda b: b.damping]
    body = eqx.tree_at(where[0], body, parts[0])
    body = eqx.tree_at(lambda b: b.force.loads.terms, body, tuple(parts[1:]))
    body = eqx.tree_at(where[1], body, body.damping * rubber.damping)
    if force.viscosity is not None:
        viscosity = force.viscosity * rubber.damping / rubber.stiffness
        body = eqx.tree_at(lambda b: b.force.viscosity, body, viscosity)
    return Solid(body, rubber.density)


def rolled(
    solid: Solid,
    state: SolidBody,
    inputs: Callable[[Array], Float[Array, " inputs"]],
    *,
    time_step: float,
    steps: int,
    implicit: float = 0.5,
) -> SolidBody:
    """The body after some steps of one length [s], from the time 0, under inputs by the time,
    in the order of the ports.

    A step of the implicit midpoint rule with one Newton pass from rest, (m + h/2 D + h^2/4 K) a
    = f(t + h/2, q + h/2 v, v): of second order, of the same cost in every state. D and K are
    the derivatives of the forces there but for how viscosity changes with the shape, which the
    order does not need. `implicit` 1 in place of 1/2 is backward Euler.
    """
    unit = jnp.eye(state.q.shape[0], dtype=state.q.dtype)
    numbers = jnp.arange(steps, dtype=state.q.dtype)
    h, early = time_step, implicit * time_step

    def run(solid: Solid, state: SolidBody) -> SolidBody:
        def one(state: SolidBody, number: Array) -> tuple[SolidBody, None]:
            given = _by_port(solid.body, inputs((number + implicit) * h))
            ahead = state.q + early * state.v
            tangent = solid.body.tangent(ahead, given, 1 / early)
            force = solid.body.pull(ahead, state.v, given)
            a = jnp.linalg.solve(solid.mass * unit + early**2 * tangent, force)
            return SolidBody(state.q + h * (state.v + early * a), state.v + h * a), None

        return jax.lax.scan(one, state, numbers)[0]

    return chunked_lanes(run, _LANES)(solid, state)


def settled(solid: Solid, given: Float[Array, " inputs"]) -> SolidBody:
    """The body when it has come to rest under held inputs, by long steps of a damped method
    while they rise from zero: a search for equilibrium may go to another one, or to none."""
    time_step, steps, rising = _SETTLING
    start = SolidBody(jnp.zeros_like(solid.body.q), jnp.zeros_like(solid.body.q))

    def raised(t):
        return given * jnp.minimum(t / (rising * time_step), 1.0)

    return rolled(solid, start, raised, time_step=time_step, steps=steps, implicit=1.0)


def places(body: ModalBody, q: Float[Array, " modes"]) -> Float[Array, "markers dim"]:
    """Where the markers of the body are [m]."""
    return jnp.stack([place + q @ moves for place, moves in body.markers.values()])


def _by_port(body: ModalBody, given: Float[Array, " inputs"]) -> dict[str, Array]:
    return {port: x for (_, port, *_), x in zip(body.ports, given, strict=True)}
