"""When Newton's method has converged or is lost, how far it may step, and how large the next
load step is.

Pure functions of numbers and arrays, of NumPy or traced: the driver on the host, that inside
a trace and that of networks decide alike.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

if TYPE_CHECKING:
    from sorojax.fem.equilibrium.newton import Newton

Number = Any  # of Python, NumPy or a trace
Truth = Any
Values = Any  # an array of NumPy or a trace

#: Share of its volume that a cell has to keep in a step of Newton's method.
LEAST_VOLUME = 0.1
#: Share of the longest step that does so, of which a shortened one is made.
SAFE = 0.9
#: Of the length of a cell: a displacement below which none is judged by its own size. Without
#: load the displacement is rounding alone, which never gets small against itself. At the usual
#: tolerance a step counts as small from 1e-12 of the length on; with 1e-9 in place of 1e-6
#: that were 1e-15, less than the rounding that a slender body amplifies.
_NO_DISPLACEMENT = 1e-6
_NO_MOVE = 1e-12  # of the largest prescribed displacement
TURNED = 0.5  # share of its slope at the start, that the energy may rise with at the end
MAX_SHORTENINGS = 12  # for that reason, of one step

_EASY, _GROWTH = 5, 1.5  # iterations of a load step after which the next one is longer
_WHOLE = 1e-9  # a rest of the load that is no step of its own


# One iterate of Newton's method


def keeps_volume(volume_ratio: Number) -> Truth:
    """Whether no cell loses so much volume in a step that it has to be shortened."""
    return volume_ratio > LEAST_VOLUME


def sound(residual_norm: Number, volume_ratio: Number) -> Truth:
    """Whether an iterate is one to go on from; if not, the step has failed."""
    return (abs(residual_norm) < float("inf")) & (volume_ratio > 0)


def balanced(
    residual_norm: Number, reference: Number, rounding: Number, tolerance: Number
) -> Truth:
    """Whether forces [N] are in balance, to the tolerance or as well as rounding lets them."""
    return (residual_norm <= tolerance * reference) | (residual_norm <= rounding)


def relative_size(step: Values, u: Values, length: Number) -> Number:
    """Largest entry of a step to the displacement `u` over that of `u`, both [m]; `length` is
    that of a cell [m]."""
    return abs(step).max() / (abs(u).max() + _NO_DISPLACEMENT * length)


def left_to_move(move: Values, known: Values) -> Values:
    """The `move` [m] to the `known` displacements of supports, without what is rounding."""
    return move * (abs(move) > _NO_MOVE * abs(known).max()).astype(move.dtype)


def converged(is_balanced: Truth, size: Number, still: Truth, newton: "Newton") -> Truth:
    """Whether an iterate is the answer: in balance, the last step small by its relative
    `size`, and all supports where they should be."""
    return is_balanced & (size < newton.step_tolerance) & still


#: Iterations of a time step at most, most of them with a kept factor, over how many `Newton`
#: allows with a tangent of their own.
MOST_ITERATIONS = 6


# A step that runs too far along its way


def turned(slope: Number, end: Number) -> Truth:
    """Whether the energy, which falls by `slope` [J] along a step at its start, rises too
    steeply at its `end`."""
    return (slope < 0) & (end > -TURNED * slope)


def shortened(share: Number, slope: Number, end: Number) -> Number:
    """The share of a step at which the slope of the energy is zero, if it is linear."""
    return share * slope / (slope - end)


# Load steps


class LoadSteps(NamedTuple):
    """How far the load has been followed: the fraction done, the size of the next step,
    failures in a row, steps that were cut and steps that were accepted."""

    done: Number
    size: Number
    failures: Number
    cuts: Number
    accepted: Number


def first_step(steps: int) -> LoadSteps:
    """Before the first of `steps` equal steps."""
    return LoadSteps(0.0, 1.0 / steps, 0, 0, 0)


def goal(way: LoadSteps) -> Number:
    """Fraction of the load that the next step goes to."""
    end = way.done + way.size
    return _chosen(end < 1.0 - _WHOLE, end, 1.0)


def accept(way: LoadSteps, iterations: Number) -> LoadSteps:
    """After a step that converged in `iterations`."""
    size = _chosen(iterations <= _EASY, _GROWTH * way.size, way.size)
    return LoadSteps(goal(way), size, 0, way.cuts, way.accepted + 1)


def cut(way: LoadSteps) -> LoadSteps:
    """After a step that failed: half of it is next."""
    size, failures = (goal(way) - way.done) / 2, way.failures + 1
    return way._replace(size=size, failures=failures, cuts=way.cuts + 1)


def goes_on(way: LoadSteps, steps: int, max_cuts: int) -> Truth:
    """Whether to try again after a cut, on a way that began with `steps` equal steps."""
    # at a limit point single steps go on for ever, each shorter than the one before
    least = 0.99 / steps / 2 ** (max_cuts + 1)
    return (way.failures <= max_cuts) & (way.size >= least)


def predicts(loads: tuple) -> bool:
    """Whether the tangent of one load step gives the first guess of the next, unless that was
    cut. Not with kinks: points that an obstacle moved into have no stiffness yet."""
    return all(load.smooth for load in loads)


def _chosen(condition: Truth, a: Number, b: Number) -> Number:
    if isinstance(condition, jax.Array):
        return jnp.where(condition, a, b)
    return a if condition else b


# Time steps


def error_ratio(error: Number, allowed: Number, u: Values, length: Number) -> Number:
    """Estimated error [m] of a time step to the displacement `u` [m] over the largest one,
    the share `allowed` of `u`: a step above 1 is not accepted."""
    return error / (allowed * (abs(u).max() + 0.01 * length))


def is_easy(iterations: Number, newton: "Newton", ratio: Number) -> Truth:
    """Whether a longer time step may follow one of that many iterations and that error."""
    return (iterations <= MOST_ITERATIONS * newton.max_iterations // 4) & (ratio < 0.1)
