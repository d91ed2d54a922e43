"""A flexible rod in free flight (D4): momentum after a pulse of force and moment on one end."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure
from sorojax._types import real
from sorojax.math.lie import SE3, homogeneous
from sorojax.math.ode.steppers import DormandPrince, GeneralisedAlpha, TripleJump
from sorojax.rod import (
    AbstractForce,
    Free,
    Part,
    PartForce,
    Section,
    assembly,
    chebyshev,
    momentum,
    num_dof,
    rest,
    rod,
    rollout,
)

LENGTH, PEAK, END = 10.0, 2.5, 5.0  # m, s
WRENCH = (0.0, 40.0, 80.0, 8.0, 0.0, 0.0)  # N m, N at the peak
MODES, NODES = 4, 12
BAR = 1e-8
REFERENCE = "momentum at the end of the pulse, 5 s to 10 s, relative"
STEPS = ((GeneralisedAlpha(1.0), 4e-3), (TripleJump(), 2e-3), (DormandPrince(), 2e-3))


class Pulse(AbstractForce):
    """A dead wrench on the base that rises to PEAK and falls to END."""

    wrench: jax.Array = eqx.field(converter=real)

    def __call__(self, t, motion):
        share = jnp.clip(jnp.minimum(t / PEAK, (END - t) / (END - PEAK)), 0, 1)
        base = motion.base
        assert base is not None  # the rod floats
        columns = jnp.concatenate([base.angular_jacobian, base.linear_jacobian])
        return share * self.wrench @ columns


def spaghetti():
    """The rod of Simo and Vu-Quoc (1988)."""
    few = MODES - 1
    basis = chebyshev(
        kappa_x=few, kappa_y=MODES, kappa_z=MODES, sigma_x=few, sigma_y=few, sigma_z=few
    )
    beam = rod(
        SE3(),
        basis,
        Section(1.0, 0.05, 0.05, 0.05, 1.0),  # 1e4 N in stretch and shear, 500 N m^2
        length=LENGTH,
        young_modulus=1e4,
        poisson_ratio=-0.5,
        density=1.0,
        nodes=NODES,
        mass_section=Section(1.0, 10.0, 10.0, 10.0, 1.0),
    )
    tilt = jnp.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    start = homogeneous(tilt, jnp.array([0.0, 8.0, 0.0]))
    return assembly(SE3(), rod=Part(beam, Free(), offset=start))


def fly(model, forces, stepper, step):
    """Momenta from the end of the pulse on, every half second."""
    zero = jnp.zeros(num_dof(model))
    path = rollout(
        model,
        rest(model),
        zero,
        forces,
        step=step,
        saves=20,
        every=round(0.5 / step),
        stepper=stepper,
    )
    return jax.vmap(lambda q, v: momentum(model, q, v))(path.q[10:], path.v[10:])


def drift(momenta):
    """Largest change, of the angular and of the linear part, each in its own size."""
    parts = [np.asarray(momenta[:, rows]) for rows in (slice(3), slice(3, 6))]
    changes = [np.abs(p - p[0]).max() / np.linalg.norm(p[0]) for p in parts]
    return float(max(changes))


def rows():
    model = spaghetti()
    forces = (PartForce("rod", Pulse(WRENCH)),)
    for stepper, h in STEPS:
        run = lambda model: fly(model, forces, stepper, h)  # noqa: B023, E731
        timing = measure(run, model, repeats=2)
        settings = {"dof": num_dof(model), "method": type(stepper).__name__, "step": h}
        barred = isinstance(stepper, DormandPrince)
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=drift(jax.jit(run)(model)),
            reference=REFERENCE,
            bar=BAR if barred else None,
            bar_on="error",
        )
