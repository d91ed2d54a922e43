"""A step of a reduced body whose surface touches things: generalised-alpha, with Newton's
method for the acceleration at its end.

Forces of the body act within the step, contact at its end. Pressure and normal of friction are
those at its beginning, so the matrix of contact is symmetric and a step that runs too far along
its way is shortened by the rules of all equilibria here.

Reference:
    Chung, Hulbert, A time integration algorithm for structural dynamics with improved
    numerical dissipation: the generalized-alpha method, J. Appl. Mech. 60, 1993.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sorojax import fem
from sorojax.contact.friction import Grip
from sorojax.fem.equilibrium import rules
from sorojax.math.implicit_root import implicit_root, matrix_of
from sorojax.systems.blocks.modal_basis import Modes
from sorojax.systems.blocks.modal_body import ModalBody

_TRIES = 8  # of the length of a step
_ROUNDING = 64  # roundings of the largest place of a point
_SMALL = 1e-9  # of the forces, that may be left without balance; more in single precision


class Moved(NamedTuple):
    """A reduced body after a step.

    Attributes:
        state: Of the block.
        acceleration: Of the modal coordinates.
        resolved: Whether forces balance.
        passes: Of Newton's method.
    """

    state: dict[str, Any]
    acceleration: Modes
    resolved: Bool[Array, ""]
    passes: Float[Array, ""]


class _Step(NamedTuple):
    """All that the balance of a step depends on but its acceleration."""

    body: ModalBody
    inputs: Mapping[str, Array]
    state: dict[str, Any]
    before: Modes
    grips: tuple[Grip | None, ...]
    h: Float[Array, ""]
    scheme: Any

    def ends(self, a: Modes) -> tuple[Modes, Modes]:
        """Coordinates and rates at the end."""
        q, v, h, scheme = self.state["q"], self.state["v"], self.h, self.scheme
        way = (0.5 - scheme.beta) * self.before + scheme.beta * a
        rise = (1 - scheme.gamma) * self.before + scheme.gamma * a
        return q + h * v + h**2 * way, v + h * rise

    def unmoved(self, a: Modes) -> Modes:
        """What the body lacks of balance, without contact."""
        (q, v), af, am = self.ends(a), self.scheme.af, self.scheme.am
        q, v = (1 - af) * q + af * self.state["q"], (1 - af) * v + af * self.state["v"]
        relaxed = self.state.get("relaxed")
        if relaxed is not None:
            times = self.body.force.relaxation_times
            relaxed = _relaxed(relaxed, q, (1 - af) * self.h, times)
        pull = self.body.pull(q, v, self.inputs, relaxed)
        return (1 - am) * a + am * self.before - pull

    def residual(self, a: Modes) -> Modes:
        """What is left of balance."""
        return self.balance(a)[0]

    def balance(self, a: Modes) -> tuple[Modes, Float[Array, ""]]:
        """That, and the size of the forces."""
        q, _ = self.ends(a)
        left = self.unmoved(a)
        size = jnp.max(jnp.abs(left)) + jnp.max(jnp.abs(a))
        for one, grip in zip(self.body.contacts, self.grips, strict=True):
            push = one.push(q, grip)
            left, size = left - push, size + jnp.max(jnp.abs(push))
        return left, size

    def matrix(
        self, a: Modes, still: Float[Array, "modes modes"]
    ) -> Float[Array, "modes modes"]:
        """Its derivative, where `still` is that without contact."""
        q, _ = self.ends(a)
        pairs = zip(self.body.contacts, self.grips, strict=True)
        stiffness = sum(one.stiffness(q, grip) for one, grip in pairs)
        return still + self.scheme.beta * self.h**2 * stiffness


class _Pass(NamedTuple):
    """Newton's method on its way: from `base` a `share` of `way`, where `left` is not balanced.

    Along the way the energy falls by `slope` at first; it has its least value between the
    shares `low`, where it still falls by `falls`, and `high`, where it rises by `rises`.
    """

    base: Modes
    way: Modes
    share: Float[Array, ""]
    left: Modes
    slope: Float[Array, ""]
    low: Float[Array, ""]
    falls: Float[Array, ""]
    high: Float[Array, ""]
    rises: Float[Array, ""]
    tries: Int[Array, ""]
    count: Int[Array, ""]
    balanced: Bool[Array, ""]


def modal_step(
    body: ModalBody,
    inputs: Mapping[str, Array],
    state: dict[str, Any],
    before: Modes,
    h: Float[Array, ""],
    rho_inf: Float[Array, ""] | float = 0.5,
    passes: int = 40,
) -> Moved:
    """The body after a step of `h` [s] under inputs that stay.

    Args:
        body: The reduced body.
        inputs: Of its ports.
        state: Of the block.
        before: Acceleration at the end of the step before.
        h: Length [s].
        rho_inf: What an oscillation much faster than the step keeps of its size [-].
        passes: Of Newton's method at most.

    Returns:
        State, acceleration, and whether forces balance.
    """
    scheme = fem.GeneralisedAlpha(rho_inf).coefficients()
    springs = state.get("stretch", (None,) * len(body.contacts))
    pairs = zip(body.contacts, springs, strict=True)
    grips = tuple(one.begun(state["q"], spring, h) for one, spring in pairs)
    now = _Step(body, inputs, state, before, grips, h, scheme)
    a, (resolved, count) = implicit_root(
        now.residual,
        before,
        lambda _, guess: _newton(now, guess, passes),
        lambda linear, right: jnp.linalg.solve(matrix_of(linear, right), right),
        has_aux=True,
    )
    q, v = now.ends(a)
    new: dict[str, Any] = {"q": q, "v": v}
    if (relaxed := state.get("relaxed")) is not None:
        new["relaxed"] = _relaxed(relaxed, q, h, body.force.relaxation_times)
    if "stretch" in state:
        pairs = zip(body.contacts, grips, strict=True)
        new["stretch"] = tuple(one.stretched(q, grip) for one, grip in pairs)
    return Moved(new, a, resolved > 0, count)


def first_acceleration(body: ModalBody, inputs: Mapping[str, Array], state) -> Modes:
    """Acceleration of a state; friction begins with springs that are not stretched."""
    pull = body.pull(state["q"], state["v"], inputs, state.get("relaxed"))
    return pull + sum(one.push(state["q"], None) for one in body.contacts)


def _relaxed(relaxed, q: Modes, span, times):
    """Coordinates of the branches after a `span` [s] that ends at `q`."""
    share = (span / times)[:, None]
    return (relaxed + share * q[None]) / (1 + share)


def _newton(now: _Step, guess: Modes, most: int) -> tuple[Modes, tuple[Array, Array]]:
    """The acceleration that balances a step, 1 where it was found, and the passes."""
    still = jax.jacfwd(now.unmoved)(guess)
    small = max(_SMALL, 64 * float(jnp.finfo(guess.dtype).eps))

    def judged(at: _Pass, unmoved: Bool[Array, ""]) -> _Pass:
        left, size = now.balance(at.base + at.share * at.way)
        # at rest without a load, forces are nothing but rounding
        balanced = (jnp.max(jnp.abs(left)) <= small * size) | unmoved
        return at._replace(left=left, balanced=balanced)

    def one(at: _Pass) -> _Pass:
        a = at.base + at.share * at.way
        way = -jnp.linalg.solve(now.matrix(a, still), at.left)
        chosen = _enough(at, at.left @ at.way)
        onward = _whole(a, way, at.left, at.count + 1)
        within = _shorter(at, at.left @ at.way)._replace(count=at.count + 1)
        new = jax.tree.map(lambda a, b: jnp.where(chosen, a, b), onward, within)
        return judged(new, chosen & ~_moves(now, way))

    none = jnp.zeros((), jnp.int32)
    begun = judged(_whole(guess, 0 * guess, guess, none), jnp.zeros((), bool))
    end = jax.lax.while_loop(lambda at: ~at.balanced & (at.count < most), one, begun)
    a = end.base + end.share * end.way
    return a, (end.balanced.astype(guess.dtype), end.count.astype(guess.dtype))


def _moves(now: _Step, change: Modes) -> Bool[Array, ""]:
    """Whether a change of the acceleration moves the surface by more than what places are
    rounded by."""
    moves, eps = jnp.zeros((), bool), float(jnp.finfo(change.dtype).eps)
    for one in now.body.contacts:
        way = now.scheme.beta * now.h**2 * jnp.abs(change)
        most = way @ jnp.max(jnp.abs(one.moves), axis=(1, 2))
        moves = moves | (most > _ROUNDING * eps * jnp.max(jnp.abs(one.places)))
    return moves


def _whole(base: Modes, way: Modes, left: Modes, count) -> _Pass:
    """A whole step of Newton's method."""
    slope = left @ way
    zero, one, none = jnp.zeros_like(slope), jnp.ones_like(slope), jnp.zeros_like(count)
    return _Pass(
        base, way, one, left, slope, zero, slope, one, zero, none, count, jnp.zeros((), bool)
    )


def _enough(at: _Pass, rise) -> Bool[Array, ""]:
    """Whether to go on from a share of a way, at which the energy changes by `rise` along it:
    a whole step is enough where it falls, a shorter one comes near the least energy."""
    near = jnp.abs(rise) <= rules.TURNED * jnp.abs(at.slope)
    return near | ((at.share >= 1) & (rise <= 0)) | (at.tries >= _TRIES)


def _shorter(at: _Pass, rise) -> _Pass:
    """Another share of the way, by false position; an end that stays counts half, after the
    Illinois method."""
    falling = rise < 0
    again = jnp.where(at.tries > 0, 0.5, 1.0)
    falls = jnp.where(falling, rise, again * at.falls)
    rises = jnp.where(falling, again * at.rises, rise)
    low = jnp.where(falling, at.share, at.low)
    high = jnp.where(falling, at.high, at.share)
    share = low + (high - low) * falls / (falls - rises)
    return at._replace(
        share=share, low=low, falls=falls, high=high, rises=rises, tries=at.tries + 1
    )
