"""Actuators that act along threads, and input maps by function."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, optional_real, real
from sorojax.rod.dynamics.points import from_own, own
from sorojax.rod.forces.forces import AbstractChamber, AbstractForce
from sorojax.rod.forces.routing import AbstractRoute, Thread, pull, thread, thread_length
from sorojax.rod.model.rod import Rod

Signal = Float[Array, " inputs"] | Callable[[Array], Array]


def _several(routes: Any) -> tuple[AbstractRoute, ...]:
    return (routes,) if isinstance(routes, AbstractRoute) else tuple(routes)


def _signal(value: Any) -> Any:
    return value if callable(value) or value is None else jnp.atleast_1d(real(value))


class Tendons(AbstractForce):
    """Threads under given tensions, fixed to the rod at their far ends.

    A thread pulls and never pushes: a negative tension is refused where it is known, and acts
    as none, with no slope, where a function of time or a traced number gives it.

    Attributes:
        routes: One routing per tendon.
        tension: [N], one per tendon, or a function of time that returns them.
        friction: Coefficient [-] by which tensions fall along the routing; None costs
            nothing.
    """

    routes: tuple[AbstractRoute, ...] = eqx.field(converter=_several)
    tension: Signal = eqx.field(converter=_signal)
    friction: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        if not callable(self.tension):
            do = "Tendons pull; put one on the other side to pull back."
            _check.not_negative("Tendons", "tension", self.tension, "N", do)

    def __call__(self, t, motion):
        return self.on_rod(motion.rod)(t, motion)

    def on_rod(self, rod):
        return _Threads(_threads(rod, self.routes), self.tension, self.friction)


class _Threads(AbstractForce):
    """Tendons in one rod."""

    threads: tuple[Thread, ...]
    tension: Signal
    friction: Float[Array, ""] | None

    def __call__(self, t, motion):
        tension = _at(self.tension, t, motion.q.dtype)
        do = "Give one tension per routing."
        _check.shape("Tendons", "tension", tension, (len(self.threads),), do)
        q = own(motion, motion.q)
        tension = jnp.where(tension >= 0, tension, jnp.zeros_like(tension))
        total = jnp.zeros_like(q)
        for index, each in enumerate(self.threads):
            total = total + tension[index] * pull(each, q, self.friction)
        return from_own(motion, total)


class ThreadChambers(AbstractChamber):
    """Thin fluidic chambers of constant section along threads, from `thread_chambers`.

    The pressure pushes with p A along the thread, by the change of its volume.
    """

    threads: tuple[Thread, ...]
    areas: Float[Array, " chambers"] = eqx.field(converter=real)
    is_single: bool = eqx.field(static=True)

    @property
    def ports(self):
        return () if self.is_single else (len(self.threads),)

    def volume(self, q):
        lengths = jnp.stack([thread_length(each, q) for each in self.threads])
        volumes = self.areas * lengths
        return volumes[0] if self.is_single else volumes


def thread_chambers(
    rod: Rod, routes: AbstractRoute | tuple[AbstractRoute, ...], areas: Numbers
) -> ThreadChambers:
    """Chambers of `areas` [m^2] along routings in `rod`, as a pressure map.

    One routing gives a scalar port, a tuple one port per chamber. The map is of this rod:
    build it again, inside a trace too, where the rod changes.

    Raises:
        ValueError: If an area is not positive or their number is not that of the routings.
    """
    is_single = isinstance(routes, AbstractRoute)
    routes = _several(routes)
    areas = jnp.atleast_1d(real(areas))
    do = "Give one area per routing, in m^2."
    _check.shape("thread_chambers", "areas", areas, (len(routes),), do)
    _check.positive("thread_chambers", "areas", areas, "m^2", do)
    return ThreadChambers(_threads(rod, routes), areas, is_single)


@eqx.filter_jit
def _threads(rod: Rod, routes: tuple[AbstractRoute, ...]) -> tuple[Thread, ...]:
    return tuple(thread(rod, route) for route in routes)


class Actuation(AbstractForce):
    """Inputs that act through a matrix of the coordinates: force = map(q) @ inputs.

    Attributes:
        map: (dof,) -> (dof, inputs).
        inputs: One number per column, or a function of time that returns them.
    """

    map: Callable[[Float[Array, " dof"]], Float[Array, "dof inputs"]]
    inputs: Signal = eqx.field(converter=_signal)

    def __call__(self, t, motion):
        q, inputs = own(motion, motion.q), _at(self.inputs, t, motion.q.dtype)
        matrix = self.map(q)
        do = "Return one row per coordinate and one column per input."
        _check.shape("Actuation", "map(q)", matrix, (q.shape[0], inputs.shape[0]), do)
        return from_own(motion, matrix @ inputs)


def _at(signal: Any, t, dtype) -> Float[Array, " inputs"]:
    value = signal(t) if callable(signal) else signal
    return jnp.atleast_1d(real(value)).astype(dtype)
