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
from jaxtyping import Array, Bool, Float

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

_FARTHEST = 1.25  # of the strains of the training, as in a network
_SETTLING = (0.05, 40, 20)  # [s], steps, and how many of them raise the pressures
_PASSES = 3  # of a step
_LANES = 4  # members at once on a CPU, whose cache holds what they need
_KNOWN = 1e-3  # of a change: below, a pass tells nothing of the derivative
_UNBALANCED = 1e-2  # of the strains of the training, by which a step may be off


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

    Raises:
        ValueError: Without double precision.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore
        raise ValueError(
            f"{where}: got single precision, need double precision to train and to read. "
            'Call jax.config.update("jax_enable_x64", True) first.'
        )
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
    passes: int = _PASSES,
) -> tuple[SolidBody, Bool[Array, ""]]:
    """The body after some steps of one length [s], from the time 0, under inputs by the time,
    in the order of the ports, and whether the forces of all steps balance.

    Steps of the implicit midpoint rule, m a = f(t + h/2, q + h/2 v + h^2/4 a, v + h/2 a), by a
    fixed number of passes of a quasi-Newton method: of second order, of the same cost in every
    state. The derivatives of all forces are found once, at the beginning, and follow the motion
    by updates of rank one. `implicit` 1 in place of 1/2 is backward Euler.

    Reference:
        Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp.
        19, 1965.
    """
    h, early = time_step, implicit * time_step
    numbers = jnp.arange(steps, dtype=state.q.dtype)

    def run(solid: Solid, state: SolidBody) -> tuple[SolidBody, Array]:
        def one(now: _Step, number: Array) -> tuple[_Step, Array]:
            given = _by_port(solid.body, inputs((number + implicit) * h))
            return _stepped(solid, now, given, h, early, passes)

        inverse = _inverse(solid, state, inputs(jnp.asarray(early, state.q.dtype)), early)
        start = _Step(state, jnp.zeros_like(state.q), inverse)
        after, changes = jax.lax.scan(one, start, numbers)
        last = changes[jnp.argmax(jnp.sum(changes**2, axis=1))]
        return after.state, solid.body.force.reach(h * early * last)

    after, off = chunked_lanes(run, _LANES)(solid, state)
    return after, off <= _UNBALANCED


class _Step(NamedTuple):
    """State, acceleration, and the inverse of the derivative of what is left of balance."""

    state: SolidBody
    a: Float[Array, " modes"]
    inverse: Float[Array, "modes modes"]


def _stepped(
    solid: Solid, now: _Step, given: dict[str, Array], h: float, early: float, passes: int
) -> tuple[_Step, Float[Array, " modes"]]:
    """After a step, and the last change of the acceleration."""
    (q, v), a, inverse = now

    def left(a: Array) -> Array:
        ahead = v + early * a
        return solid.body.pull(q + early * ahead, ahead, given) - solid.mass * a

    lacks = left(a)
    change = inverse @ lacks
    for _ in range(passes - 1):
        a, before = a + change, lacks
        lacks = left(a)
        inverse = _updated(inverse, change, before - lacks)
        change = inverse @ lacks
    a = a + change
    return _Step(SolidBody(q + h * (v + early * a), v + h * a), a, inverse), change


def _inverse(solid: Solid, state: SolidBody, given: Float[Array, " inputs"], early: float):
    """Of the derivative of m a - f by a, after a time `early` without acceleration; without
    that of the viscosity by the shape, which is small and dear."""
    ahead, pressures = state.q + early * state.v, _by_port(solid.body, given)
    loads, unit = solid.body.loads(pressures), jnp.eye(state.q.shape[0], dtype=state.q.dtype)
    stiffness = jax.jacfwd(lambda q: loads(q) - solid.body.force(q))(ahead)
    damping = jax.jacfwd(lambda v: solid.body.pull(ahead, v, pressures))(state.v)
    return jnp.linalg.inv(solid.mass * unit - early * damping - early**2 * stiffness)


def _updated(
    inverse: Float[Array, "modes modes"], change: Float[Array, " modes"], fell: Array
) -> Float[Array, "modes modes"]:
    """The inverse that makes of what the balance `fell` by the `change` that it came from."""
    row, along = change @ inverse, inverse @ fell
    share = row @ fell
    known = jnp.abs(share) > _KNOWN * (change @ change)
    new = inverse + jnp.outer(change - along, row) / jnp.where(known, share, 1.0)
    return jnp.where(known, new, inverse)


def settled(solid: Solid, given: Float[Array, " inputs"]) -> SolidBody:
    """The body when it has come to rest under held inputs, by long steps of a damped method
    while they rise from zero: a search for equilibrium may go to another one, or to none."""
    time_step, steps, rising = _SETTLING
    start = SolidBody(jnp.zeros_like(solid.body.q), jnp.zeros_like(solid.body.q))

    def one(state: SolidBody, number: Array):
        def raised(t):
            return given * jnp.minimum((number + t / time_step) / rising, 1.0)

        how = {"time_step": time_step, "steps": 1, "implicit": 1.0, "passes": 1}
        return rolled(solid, state, raised, **how)[0], None

    return jax.lax.scan(one, start, jnp.arange(steps, dtype=start.q.dtype))[0]


def places(body: ModalBody, q: Float[Array, " modes"]) -> Float[Array, "markers dim"]:
    """Where the markers of the body are [m]."""
    return jnp.stack([place + q @ moves for place, moves in body.markers.values()])


def known(body: ModalBody, q: Float[Array, " modes"]) -> Bool[Array, ""]:
    """Whether the strains are as far as the training allows."""
    return body.force.reach(q) <= _FARTHEST


def _by_port(body: ModalBody, given: Float[Array, " inputs"]) -> dict[str, Array]:
    return {port: x for (_, port, *_), x in zip(body.ports, given, strict=True)}
