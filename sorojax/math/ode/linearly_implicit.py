"""A fixed-step integrator with one solution of linear equations per step, for large batches."""

from typing import ClassVar

import jax.numpy as jnp

from sorojax.math.linalg.dense import solve_symmetric
from sorojax.math.ode.steppers import (
    AbstractStepper,
    Kinematic,
    move,
    placed,
    remembered,
    within,
)


class LinearlyImplicit(AbstractStepper):
    """Backward Euler with one Newton pass: first order, of the same cost in contact and apart.

    (M + h D + h^2 K) a = f(t + h, q + h v, v), then v + h a and q + h (v + h a), where D and K
    hold the damping and stiffness of contacts too. Nothing is searched or tried again, so all
    members of a batch cost the same, and a derivative is that of the steps taken. A contact
    that begins is met with its own stiffness, not with that of a step before it. What is faster
    than the step is damped; `ContactMidpoint` keeps energy and looks for what went through.

    Reference:
        Baraff and Witkin, Large steps in cloth simulation, SIGGRAPH 1998.
    """

    settles: ClassVar[bool] = False

    def begin(self, problem, t, q, v):
        # no step reads the acceleration before it
        memory = None if problem.memory is None else problem.memory.begin
        return placed(problem, t, Kinematic(q, v, 0 * v, memory=memory))

    def step(self, problem, t, h, state):
        if problem.held is not None:
            raise ValueError(
                "LinearlyImplicit: got a model with closures, need one without: its steps do "
                "not solve for reactions. Take GeneralisedAlpha()."
            )
        inner = within(problem, h, state)
        ahead = move(problem, state.q, h * state.v)
        damping, stiffness = inner.damping, inner.stiffness
        solve = solve_symmetric
        if inner.contact is None:
            mass, force = inner.equations(t + h, ahead, state.v)
        else:
            mass, force, _ = inner.contact.free(t + h, ahead, state.v)
            touching, grown, viscous = inner.contact.force(t + h, ahead, state.v)
            force, stiffness, damping = force + touching, stiffness + grown, damping + viscous
            # what friction gains with pressure is on one side of the diagonal
            solve = solve_symmetric if inner.contact.symmetric else jnp.linalg.solve
        a = solve(mass + h * damping + h**2 * stiffness, force)
        v = state.v + h * a
        q = move(problem, state.q, h * v)
        memory = remembered(problem, h, state, q)
        return Kinematic(q, v, a, memory=memory, share=state.share)
