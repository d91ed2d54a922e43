"""A controller that knows the model as a force on its rod: closed loops in `rod.rollout`."""

from sorojax.rod import AbstractForce
from sorojax.systems.model_control import AbstractLaw


class ControlForce(AbstractForce):
    """The effort of a law that sees coordinates and rates at every instant.

    `rod.rollout(rod, q, v, (ControlForce(law), contact), ...)` moves the closed loop with a
    stepper made for contact; `Sampled` is the loop of a computer with ticks.

    Attributes:
        law: `ComputedTorque`, `CartesianImpedance`, ...
    """

    law: AbstractLaw

    def __call__(self, t, motion):
        return self.law.effort(t, motion.q, motion.v)
