"""Forces whose numbers change with time."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from sorojax.rod.forces import AbstractForce


class Varying(AbstractForce):
    """A force made anew at every instant from a signal: `make(signal(t))`.

    `Varying(TipWrench, wave)` is a tip wrench that follows `wave`, any function of time
    [s]; with a module as the signal its numbers are differentiable and never retrace.

    Attributes:
        make: From the value of the signal to a force.
        signal: From time [s] to what `make` takes, e.g. a reference of `systems`.
    """

    make: Callable[[Any], AbstractForce] = eqx.field(static=True)
    signal: Callable[[Float[Array, ""]], Any]

    def __call__(self, t, motion):
        return self.make(self.signal(t))(t, motion)
