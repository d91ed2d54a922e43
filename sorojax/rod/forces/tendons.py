"""Threads through a rod: their routing, lengths and slopes; tendons that pull on them.

The tangent of a thread, seen from the section, is affine in the strain. So its length
depends on the coordinates of the rod alone, and every derivative is exact.
"""

import abc
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._types import Numbers, optional_real, real
from sorojax.math.compiled import jit_public
from sorojax.math.lie import cross_columns
from sorojax.math.quadrature import Quadrature, gauss_legendre, integration_matrix
from sorojax.rod.dynamics.fields import strains_at
from sorojax.rod.dynamics.points import from_own, own, safe_norm
from sorojax.rod.forces.forces import AbstractChamber, AbstractForce
from sorojax.rod.model.basis import STRAINS
from sorojax.rod.model.rod import Rod, strain_names


class AbstractRoute(eqx.Module):
    """A thread: its place in the section along the rod, from `start` to `stop` in [0, 1].

    `nodes` is the number of Gauss points between two breaks of the strain basis.
    """

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        start: ClassVar[float]
        stop: ClassVar[float]
        nodes: ClassVar[int]

    def __check_init__(self):
        if not 0 <= self.start < self.stop <= 1:
            raise ValueError(
                f"{type(self).__name__}: runs from {self.start} to {self.stop}, need "
                "0 <= start < stop <= 1. Divide the arc length [m] by that of the rod."
            )

    @abc.abstractmethod
    def offset(self, s: Float[Array, ""]) -> Float[Array, "2"]:
        """Local (y, z) of the thread at `s` [m]; a planar rod bends in y."""


class Straight(AbstractRoute):
    """A thread along the rod at a constant `place` (y, z) [m] in the section."""

    place: Float[Array, "2"] = eqx.field(converter=real)
    start: float = eqx.field(static=True, default=0.0)
    stop: float = eqx.field(static=True, default=1.0)
    nodes: int = eqx.field(static=True, default=12)

    def offset(self, s):
        return jnp.broadcast_to(self.place, (2,))


class Converging(AbstractRoute):
    """A thread whose place (y, z) [m] moves linearly from `first` at the base to `last` at the
    end of the rod, whatever part of it the thread takes."""

    first: Float[Array, "2"] = eqx.field(converter=real)
    last: Float[Array, "2"] = eqx.field(converter=real)
    start: float = eqx.field(static=True, default=0.0)
    stop: float = eqx.field(static=True, default=1.0)
    nodes: int = eqx.field(static=True, default=16)

    def offset(self, s):
        return (1 - s) * self.first + s * self.last


class Helical(AbstractRoute):
    """A thread that winds about the axis of the rod.

    Attributes:
        radius: Distance from the axis [m].
        turns: Turns over the whole rod, positive about local x [-].
        phase: Angle from local y at the base [rad].
    """

    radius: Float[Array, ""] = eqx.field(converter=real)
    turns: Float[Array, ""] = eqx.field(converter=real)
    phase: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    start: float = eqx.field(static=True, default=0.0)
    stop: float = eqx.field(static=True, default=1.0)
    nodes: int = eqx.field(static=True, default=32)

    def offset(self, s):
        angle = self.phase + 2 * np.pi * self.turns * s
        return self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


class Routed(AbstractRoute):
    """A thread at its `place`, any smooth function from s in [0, 1] to (y, z) [m]."""

    place: Callable[[Array], Array]
    start: float = eqx.field(static=True, default=0.0)
    stop: float = eqx.field(static=True, default=1.0)
    nodes: int = eqx.field(static=True, default=32)

    def offset(self, s):
        return real(self.place(s)).astype(s.dtype)


class Thread(NamedTuple):
    """A routing in one rod: what of its tangent and curvature is constant, what linear in q.

    Attributes:
        weights: Gauss weights [m].
        tangent, tangent_rows: d place / ds along the axes of the section [-].
        curvature, curvature_rows: Curvature of the rod there [1/m].
        rule: Where the points are.
        start: Where on the rod it begins [m].
        span: Length of rod that the thread takes [m].
    """

    weights: Float[Array, " points"]
    tangent: Float[Array, "points 3"]
    tangent_rows: Float[Array, "points 3 dof"]
    curvature: Float[Array, "points 3"]
    curvature_rows: Float[Array, "points 3 dof"]
    rule: Quadrature
    start: Float[Array, ""]
    span: Float[Array, ""]


def thread(rod: Rod, route: AbstractRoute) -> Thread:
    """The routing in `rod`; differentiable in both."""
    dtype, share = rod.length.dtype, route.stop - route.start
    inner = [(b - route.start) / share for b in rod.quadrature.breaks]
    rule = Quadrature(route.nodes, tuple(b for b in inner if 0 < b < 1))
    s = route.start + share * gauss_legendre(rule)[0]
    place, slope = jax.vmap(lambda s: jax.jvp(route.offset, (s,), (jnp.ones_like(s),)))(
        jnp.asarray(s, dtype)
    )
    _check.shape(type(route).__name__, "place", place[0], (2,), "Give (y, z) in metres.")
    rest, rows = _strains(rod, s)
    arm = jnp.pad(place, ((0, 0), (1, 0)))
    tangent = rest[:, 3:] + jnp.pad(slope, ((0, 0), (1, 0))) / rod.length
    bent = cross_columns(rows[:, :3], arm[:, :, None])
    return Thread(
        weights=rod.length * share * jnp.asarray(gauss_legendre(rule)[1], dtype),
        tangent=tangent + cross_columns(rest[:, :3], arm),
        tangent_rows=rows[:, 3:] + bent,
        curvature=rest[:, :3],
        curvature_rows=rows[:, :3],
        rule=rule,
        start=rod.length * route.start,
        span=rod.length * share,
    )


def thread_length(thread: Thread, q: Float[Array, " dof"]) -> Float[Array, ""]:
    """Length [m] of a thread; its gradient is the arm of its tension."""
    return thread.weights @ safe_norm(thread.tangent + thread.tangent_rows @ q)


@jit_public
def thread_lengths(
    rod: Rod, routes: tuple[AbstractRoute, ...], q: Float[Array, " dof"]
) -> Float[Array, " threads"]:
    """Lengths [m] of the threads in `rod`.

    Args:
        rod: The rod.
        routes: The routings of the threads.
        q: Coordinates.

    Returns:
        Lengths [m], one per thread.
    """
    return jnp.stack([thread_length(thread(rod, route), q) for route in routes])


@jit_public
def thread_rates(
    rod: Rod,
    routes: tuple[AbstractRoute, ...],
    q: Float[Array, " dof"],
    v: Float[Array, " dof"],
) -> Float[Array, " threads"]:
    """Rates [m/s] of the lengths of the threads.

    Args:
        rod: The rod.
        routes: The routings of the threads.
        q: Coordinates.
        v: Their rates, per second.

    Returns:
        Rates [m/s], one per thread.
    """
    return jax.jvp(lambda q: thread_lengths(rod, routes, q), (q,), (v,))[1]


def pull(
    thread: Thread, q: Float[Array, " dof"], friction: Float[Array, ""] | None = None
) -> Float[Array, " dof"]:
    """Generalised force per tension at the base end [m]: minus the slope of the length.

    With a `friction` coefficient [-] the tension falls by exp(-friction * angle) along the
    thread, for a thread that is drawn towards the base.

    Reference:
        Euler and Eytelwein's capstan equation.
    """
    tangent = thread.tangent + thread.tangent_rows @ q
    size = safe_norm(tangent)
    unit = tangent / size[:, None]
    weights = thread.weights
    if friction is not None:
        weights = weights * jnp.exp(-friction * _turned(thread, q, unit))
    loads = weights[:, None] * unit
    return -loads.reshape(-1) @ thread.tangent_rows.reshape(-1, q.shape[0])


def _turned(thread: Thread, q: Array, unit: Array) -> Float[Array, " points"]:
    """Angle [rad] by which the thread has turned between its start and each point."""
    dtype = q.dtype
    slope = jnp.asarray(_differentiation(thread.rule), dtype) @ unit / thread.span
    curvature = thread.curvature + thread.curvature_rows @ q
    bending = safe_norm(slope + cross_columns(curvature, unit))
    return thread.span * (jnp.asarray(integration_matrix(thread.rule), dtype) @ bending)


def _differentiation(rule: Quadrature) -> np.ndarray:
    """Derivatives at the nodes of what is known there, span by span, per unit of [0, 1]."""
    nodes = gauss_legendre(rule.count)[0]
    differences = nodes[:, None] - nodes[None, :] + np.eye(rule.count)
    products = np.prod(differences, axis=1)
    matrix = products[:, None] / (products[None, :] * differences)
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -np.sum(matrix, axis=1))
    whole = np.zeros((rule.num_nodes, rule.num_nodes))
    for k, size in enumerate(np.diff(rule.edges)):
        block = slice(k * rule.count, (k + 1) * rule.count)
        whole[block, block] = matrix / size
    return whole


def _strains(rod: Rod, s: np.ndarray) -> tuple[Array, Array]:
    """Rest strain (points, 6) and strain per coordinate (points, 6, dof) at `s`."""
    rest, rows = strains_at(rod, s)
    at = np.array([STRAINS.index(name) for name in strain_names(rod.group)])
    blank = jnp.zeros((len(s), len(STRAINS), rod.basis.num_dof), rod.length.dtype)
    return blank[:, :, 0].at[:, at].set(rest), blank.at[:, at].set(rows)


Signal = Float[Array, " inputs"] | Callable[[Array], Array]


def _several(routes: AbstractRoute | Sequence[AbstractRoute]) -> tuple[AbstractRoute, ...]:
    return (routes,) if isinstance(routes, AbstractRoute) else tuple(routes)


def _signal(value: Any) -> Any:
    return value if callable(value) or value is None else jnp.atleast_1d(real(value))


class Tendons(AbstractForce):
    """Threads under given tensions, fixed to the rod at their far ends.

    A thread pulls and never pushes: a negative tension is refused where it is known, and acts
    as none, with no slope, where a function of time or a traced number gives it.

    Attributes:
        routes: One routing per tendon.
        tension: [N], one per tendon, or a function of time that returns them; None where a
            network commands them, by the input `tension` of `systems.RodBody`.
        friction: Coefficient [-] by which tensions fall along the routing; None costs
            nothing.
    """

    routes: tuple[AbstractRoute, ...] = eqx.field(converter=_several)
    tension: Signal | None = eqx.field(converter=_signal, default=None)
    friction: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        if self.tension is not None and not callable(self.tension):
            do = "Tendons pull; put one on the other side to pull back."
            _check.not_negative("Tendons", "tension", self.tension, "N", do)

    def __call__(self, t, motion):
        return self.on_rod(motion.rod)(t, motion)

    def on_rod(self, rod):
        if self.tension is None:
            raise ValueError(
                "Tendons: got no `tension`, need one per routing. Give it [N], or list the "
                "tendons in a RodBody and wire its `tension`."
            )
        return _Threads(_threads(rod, self.routes), self.tension, self.friction)

    @property
    def ports(self) -> tuple[int, ...]:
        """Shape of commanded tensions: a number for one tendon."""
        return () if len(self.routes) == 1 else (len(self.routes),)

    def pulled(self, tension: Float[Array, "*ports"]) -> "Tendons":
        """The same under `tension` [N], which may be negative and is then none."""
        return Tendons(self.routes, lambda t: jnp.atleast_1d(tension), self.friction)


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

    The pressure pushes with p A along the thread, by the change of its volume. `areas` [m^2]
    are the sections A, one for each of `threads`. Where `is_single` there is one, and pressure
    and volume are numbers.
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

    Args:
        rod: The rod.
        routes: One routing, or a tuple of them.
        areas: Cross-section of each chamber [m^2].

    Returns:
        The pressure map, for `Pressurised`.

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


@once
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
    value: Any = signal(t) if callable(signal) else signal
    return jnp.atleast_1d(real(value)).astype(dtype)
