"""What an optimiser is: from one design, and the functions there, to the next design.

A new method is a class in a file of this folder, exported by `sorojax.design`.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, PyTree


class Values(NamedTuple):
    """`objective` and `constraints` (each <= 0) at one design, with their derivatives:
    `gradient` is that of the objective, row i of `slopes` that of constraint i."""

    objective: Float[Array, ""]
    gradient: Float[Array, " n"]
    constraints: Float[Array, " m"]
    slopes: Float[Array, "m n"]


Evaluate = Callable[[Float[Array, " n"]], tuple[Float[Array, ""], Float[Array, " m"]]]


class AbstractOptimiser(eqx.Module):
    """A method of `minimise`, for designs that are vectors.

    Attributes:
        scaled: Whether the objective comes divided by its size; `False` where the method does
            not depend on it, or is to see it as it is.
    """

    scaled: ClassVar[bool] = True

    @abc.abstractmethod
    def init(self, x: Float[Array, " n"], constraints: int) -> PyTree:
        """Memory before the first step from `x` with so many constraints.

        Raises:
            ValueError: If the method takes another number of constraints.
        """

    @abc.abstractmethod
    def update(
        self, x: Float[Array, " n"], values: Values, memory: PyTree, evaluate: Evaluate
    ) -> tuple[Float[Array, " n"], PyTree]:
        """The next design, and the memory to pass on.

        Args:
            x: The design.
            values: Objective and constraints at `x`, with their derivatives.
            memory: What the step before passed on.
            evaluate: Objective and constraints at another design, without derivatives: a call
                costs a solve.
        """

    def is_settled(self, memory: PyTree) -> bool:
        """Whether a small step, after which `memory` is passed on, says that the search is
        over; it does unless a method shortens its steps for other reasons."""
        return True
