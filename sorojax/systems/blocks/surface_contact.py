"""Contact of the surface of a reduced body with shapes that do not deform: the penalty and the
friction of `fem.Contact`, on points that move in the shapes of a basis."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import fem
from sorojax.contact import Penalty, SpringSlider
from sorojax.contact.facet import surface
from sorojax.contact.friction import Grip
from sorojax.fem.loads.facets import areas_of
from sorojax.sdf.base import AbstractSdf
from sorojax.systems.blocks.modal_basis import Basis, Modes

#: Length of the spring at every point [m]; None without friction.
Stretch = Float[Array, "points dim"] | None

_NEAR = 0.03  # of the largest change of a gap in training


class SurfaceContact(eqx.Module):
    """Points of the surface, each for an area, that an obstacle keeps out.

    Friction is a spring at every point that slides at the limit of its law, so points that
    hold do not creep. What it remembers from step to step is the `stretch` of the springs. As
    in `fem.Contact` pressure and normal of friction are those where the step begins.

    Attributes:
        obstacle: In the world.
        law: Pressure by the gap.
        slider: Friction; None without any.
        places: Of the points at q = 0 [m].
        moves: Their derivatives by the modal coordinates.
        areas: At rest [m^2].
        offset: How far before the obstacle pressure starts [m]; None for nothing.
        apart: Points that training left out, as they came nowhere near; None for none.
    """

    obstacle: AbstractSdf
    law: Penalty
    slider: SpringSlider | None
    places: Float[Array, "points dim"]
    moves: Float[Array, "modes points dim"]
    areas: Float[Array, " points"]
    offset: Float[Array, " points"] | None = None
    apart: "SurfaceContact | None" = None

    def points(self, q: Modes) -> Float[Array, "points dim"]:
        """Where the points are [m]."""
        return self.places + jnp.tensordot(q, self.moves, 1)

    def gap(self, q: Modes) -> Float[Array, " points"]:
        """How far the points are from where pressure starts [m]; negative inside."""
        return self._shifted(surface(self.obstacle, self.points(q))[0])

    def clearance(self, q: Modes) -> Float[Array, ""]:
        """Smallest gap of the points that were left out [m]; negative once one is inside."""
        return jnp.min(self.apart.gap(q)) if self.apart is not None else jnp.asarray(jnp.inf)

    def near(self, states: Float[Array, "states modes"]) -> "SurfaceContact":
        """Without the points that come in none of these states as near as 3 % of the
        largest change of a gap among them; with all if none does."""
        gaps = np.asarray(jax.vmap(self.gap)(states))
        close = gaps.min(axis=0) <= _NEAR * np.ptp(gaps, axis=0).max()
        if close.all() or not close.any():
            return self
        return dataclasses.replace(self._of(close), apart=self._of(~close))

    def _of(self, chosen: Bool[np.ndarray, " points"]) -> "SurfaceContact":
        (at,) = np.nonzero(chosen)
        return dataclasses.replace(
            self,
            places=self.places[at],
            moves=self.moves[:, at],
            areas=self.areas[at],
            offset=None if self.offset is None else self.offset[at],
        )

    def unstretched(self) -> Stretch:
        """The springs of friction without load."""
        return None if self.slider is None else jnp.zeros_like(self.places)

    def begun(self, q: Modes, stretch: Stretch, h: Float[Array, ""]) -> Grip | None:
        """Friction of a step of `h` [s] that begins at `q` with springs of this length [m]."""
        if self.slider is None or stretch is None:
            return None
        back = self.points(q)
        gap, _, normal = surface(self.obstacle, back)
        pressure = self.law.pressure(self._shifted(gap))
        limit = self.slider.law.limit(pressure)
        anchor = back - self.slider.bounded(stretch, pressure, normal)
        drag = limit / (self.slider.velocity * h)
        return Grip(anchor, pressure, normal, drag, back)

    def stretched(self, q: Modes, grip: Grip | None) -> Stretch:
        """Length of the springs after a step to `q` [m]."""
        if self.slider is None or grip is None:
            return None
        return self.slider.stretch(grip, self.points(q))

    def push(self, q: Modes, grip: Grip | None) -> Modes:
        """Force on the modal coordinates."""
        force = self.areas[:, None] * self._traction(self.points(q), grip)
        return jnp.tensordot(self.moves, force, 2)

    def stiffness(self, q: Modes, grip: Grip | None) -> Float[Array, "modes modes"]:
        """Minus the derivative of the force."""
        x, moves = self.points(q), self.moves

        def along(axis: Float[Array, " dim"]):
            way = jnp.broadcast_to(axis, x.shape)
            return jax.jvp(lambda x: self._traction(x, grip), (x,), (way,))[1]

        weighed = -self.areas[None, :, None] * jax.vmap(along)(jnp.eye(x.shape[1]))
        turned = jnp.einsum("mpj,jpi->mpi", moves, weighed)
        count = len(moves)
        return moves.reshape(count, -1) @ turned.reshape(count, -1).T

    def _traction(self, x: Float[Array, "points dim"], grip: Grip | None):
        """Force of the obstacle per area [Pa]."""
        gap, slope, _ = surface(self.obstacle, x)
        pushed = self.law.pressure(self._shifted(gap))[:, None] * slope
        if self.slider is None or grip is None:
            return pushed
        return pushed + self.slider.traction(grip, x)

    def _shifted(self, gap: Float[Array, " points"]) -> Float[Array, " points"]:
        return gap if self.offset is None else gap - self.offset


def surface_contact(problem: fem.Problem, load: fem.Contact, basis: Basis) -> SurfaceContact:
    """A contact of a problem, on the points of its quadrature."""
    still = load.points_of(problem, basis.displacement)
    rest = load.points_of(problem, jnp.zeros_like(basis.displacement))
    moved = jax.vmap(lambda shape: load.points_of(problem, shape))(basis.shapes)
    flat = (-1, still.shape[-1])
    return SurfaceContact(
        load.obstacle,
        load.law,
        None if load.friction is None else load.slider,
        (still - load.value[None, None]).reshape(flat),
        (moved - rest[None]).reshape(len(basis), *flat),
        areas_of(problem, load.facets).ravel(),
        None if load.offset is None else load.offset.ravel(),
    )


def contacts_of(problem: fem.Problem) -> tuple[fem.Contact, ...]:
    """Contacts of the surface of a body with shapes that do not deform."""
    return tuple(load for load in problem.loads if isinstance(load, fem.Contact))
