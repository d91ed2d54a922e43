"""How a model with closures can move: its freedoms, equations that say nothing new, and poses
at which it gains a freedom."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._display import printed
from sorojax._types import real
from sorojax.rod.dynamics.closures import closure_jacobian, violations
from sorojax.rod.model.assembly import dtype_of, num_dof, retract
from sorojax.rod.model.closure import equations
from sorojax.rod.model.model import Model, motion, operators
from sorojax.rod.model.rod import Rod
from sorojax.rod.statics.equilibrium import first_guess, metric, unit_energy

_AWAY, _TRIES = 0.02, 3  # bends [rad] to the poses beside one, and how many
_CORRECTIONS = 12


@printed
class Mobility(eqx.Module):
    """Freedoms of a model with closures at a pose.

    Attributes:
        freedoms: Independent motions that keep the loops closed, strains of rods included.
        redundant: Closures whose equations follow in part from those before, at any pose
            around: how many by name. Their reactions are not unique in rigid parts.
        singular: Whether more equations depend on each other here than at poses around, so
            that the model has a motion here that it has not beside.
    """

    freedoms: int = eqx.field(static=True)
    redundant: dict[str, int] = eqx.field(static=True)
    singular: bool = eqx.field(static=True)

    def _text(self) -> str:
        named = ", ".join(f"{name} {count}" for name, count in self.redundant.items())
        pose = "singular pose" if self.singular else "regular pose"
        return f"Mobility: {self.freedoms} freedoms, redundant: {named or 'none'}, {pose}"


def mobility(
    model: Model, q: Float[Array, " coordinates"] | None = None, *, t=0.0, tolerance=1e-6
) -> Mobility:
    """Freedoms of a model whose loops are closed at `q`, from the rank of G = dg/dq.

    Rates are measured in elastic energy, rows of G brought to one. Redundant is what depends on
    other equations at poses around too, to which the model is moved with its loops closed;
    singular is what does so here alone.

    Args:
        model: The rod or assembly.
        q: Coordinates at which the loops are closed, as those of `equilibrium`; at rest by
            default.
        t: Time at which closures are moved [s].
        tolerance: Singular values that count as zero, relative to the largest [-].

    Returns:
        Freedoms, redundant equations by closure, and whether the pose is singular. On the host,
        not for `jit`.

    Raises:
        ValueError: If `q` has the wrong shape, or does not close the loops.

    Example:
        >>> link = rod.Link(0.1, 1e-4)
        >>> arm = rod.assembly(SE2(), a=rod.Part(link, rod.Revolute()))
        >>> held = rod.with_closures(arm, pin=rod.Closure("a", rod.Revolute()))
        >>> rod.mobility(held)
        Mobility: 1 freedoms, redundant: pin 2, regular pose

    Reference:
        Mueller, "Generic mobility of rigid body mechanisms", Mech. Mach. Theory 44, 2009.
    """
    q, t = first_guess("mobility", model, q), real(t).astype(dtype_of(model))
    places = () if isinstance(model, Rod) else equations(model)
    if not places:
        return Mobility(num_dof(model), {}, False)
    unit = jnp.linalg.cholesky(metric(model, operators(model)))
    size = jnp.sqrt(unit_energy(model, unit @ unit.T))

    @jax.jit
    def at(q: Array) -> tuple[Array, Array]:
        moment: Any = motion(model, q)
        rows = jax.scipy.linalg.solve_triangular(
            unit, closure_jacobian(moment, t).T, lower=True
        )
        return violations(moment, t), size * rows.T

    @jax.jit
    def moved(q: Array, along: Array) -> Array:
        increment = jax.scipy.linalg.solve_triangular(unit.T, size * along, lower=False)
        return retract(model, q, increment)

    gap, rows = (np.asarray(x) for x in at(q))
    _check_closed(model, gap)
    here = _ranks(rows, places, tolerance)
    around = here
    for key in range(_TRIES):
        beside = _beside(at, moved, q, rows, np.random.default_rng(key), tolerance)
        around = np.maximum(around, _ranks(beside, places, tolerance))
    held = np.array([place.stop - place.start for place in places])
    missing = held - np.diff(around, prepend=0)
    loops = model.loops  # type: ignore[union-attr]
    redundant = {name: int(count) for name, count in zip(loops, missing, strict=True) if count}
    return Mobility(num_dof(model) - int(here[-1]), redundant, bool(here[-1] < around[-1]))


def _beside(at, moved, q: Array, rows: np.ndarray, random, tolerance: float) -> np.ndarray:
    """G at a pose near by, with the loops closed."""
    push = random.standard_normal(rows.shape[1])
    push = push - np.linalg.pinv(rows, rcond=tolerance) @ (rows @ push)
    pose = moved(q, jnp.asarray(_AWAY * push / max(np.linalg.norm(push), 1e-300), q.dtype))
    for _ in range(_CORRECTIONS):
        gap, rows = (np.asarray(x) for x in at(pose))
        pose = moved(pose, jnp.asarray(-np.linalg.pinv(rows, rcond=tolerance) @ gap, q.dtype))
    return np.asarray(at(pose)[1])


def _ranks(rows: np.ndarray, places: tuple[slice, ...], tolerance: float) -> np.ndarray:
    """Rank of the equations of the first closure, of the first two, ..."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows / np.where(lengths > tolerance * lengths.max(), lengths, np.inf)
    return np.array([np.linalg.matrix_rank(rows[: at.stop], tol=tolerance) for at in places])


def _check_closed(model: Any, gap: np.ndarray) -> None:
    worst = float(np.max(np.abs(gap)))
    if not worst < 1e-6:
        raise ValueError(
            f"mobility: loops are open by {worst:.3g} rad or m at `q`, need them closed. Find "
            "q by equilibrium, or by inverse_kinematics."
        )
