"""Fixed steps of stiff systems at the price of two slopes and one small product each."""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from sorojax.math.method import AbstractMethod, Step

_GAMMA = 1 - 2**-0.5


class Rosenbrock2(AbstractMethod):
    """Method of order 2 for fixed steps, whose Jacobian may be old.

    The order holds for any matrix, the stability for a matrix near the Jacobian: it is taken
    once at the start of a run, which suits rods (constant stiffness and damping in their
    coordinates) with slow changes of inertia, or at every saved instant or tick. With the
    Jacobian of its own step the method is L-stable.

    Attributes:
        refresh: Take a new Jacobian at every saved instant or tick of a controller.

    Reference:
        Verwer, Spee, Blom, Hundsdorfer, A second-order Rosenbrock method applied to
        photochemical dispersion problems, SIAM J. Sci. Comput. 20, 1999.
    """

    refresh: bool = eqx.field(static=True, default=False)
    num_order: ClassVar[int] = 2
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    @property
    def keeps(self) -> bool:
        return not self.refresh

    def begin(self, field, t, y, h):
        flat, unravel = ravel_pytree(y)
        jacobian = jax.jacfwd(lambda x: ravel_pytree(field(t, unravel(x)))[0])(flat)
        eye = jnp.eye(flat.shape[0], dtype=flat.dtype)
        return jnp.linalg.inv(eye - _GAMMA * h * jacobian)

    def advance(self, field, t, y, h, memory):
        flat, unravel = ravel_pytree(y)

        def slope(t, x):
            return ravel_pytree(field(t, unravel(x)))[0]

        first = memory @ slope(t, flat)
        second = memory @ (slope(t + h, flat + h * first) - 2 * first)
        return Step(unravel(flat + h * (1.5 * first + 0.5 * second)), None, memory, {})
