"""What a load may know about the time step that it acts in."""

from typing import NamedTuple

from jaxtyping import Array, Float


class StepState(NamedTuple):
    """A time step before it is solved.

    Forces act at one state u within the step, whose velocity is `rate * (u - back)`.

    Attributes:
        u: Displacement at the start of the step [m].
        v: Velocity at the start of the step [m/s].
        back: Displacement that the velocity is counted from [m].
        rate: Velocity over displacement from `back` [1/s].
        guess: Explicit prediction of the state that forces act at [m].
        t: Time of that state [s].
        step: Size of the step [s].
        share: How far within the step the state is that forces act at.
    """

    u: Float[Array, "nodes dim"]
    v: Float[Array, "nodes dim"]
    back: Float[Array, "nodes dim"]
    rate: Float[Array, ""]
    guess: Float[Array, "nodes dim"]
    t: Float[Array, ""]
    step: Float[Array, ""]
    share: Float[Array, ""] | float = 1.0
