"""A flexible rod in free flight, in space and in the plane: momentum after a pulse of force
and moment on one end, and its ends beside an independent solution."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.discrete_rod import Bar, flight
from benchmarks.harness import Row, measure, quick
from sorojax._types import real
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.ode.steppers import DormandPrince, GeneralisedAlpha, TripleJump
from sorojax.rod import (
    AbstractForce,
    Free,
    Part,
    PartForce,
    Section,
    assembly,
    chebyshev,
    forward_kinematics,
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


TILT = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
START = np.array([0.0, 8.0, 0.0])
BAR_OF_ENDS = 5e-3
INDEPENDENT = "both ends after 5 s, discrete elements (SciPy), relative to the length"


def rising(t):
    """Of the pulse in space: it rises to PEAK and falls to END."""
    return jnp.clip(jnp.minimum(t / PEAK, (END - t) / (END - PEAK)), 0, 1)


def constant(t):
    """Of the pulse in the plane: whole until PEAK."""
    return jnp.where(t < PEAK, 1.0, 0.0)


class Pulse(AbstractForce):
    """A dead wrench on the base, times a function of time."""

    wrench: jax.Array = eqx.field(converter=real)
    share: Callable = eqx.field(static=True, default=rising)

    def __call__(self, t, motion):
        share = self.share(t)
        base = motion.base
        assert base is not None  # the rod floats
        columns = jnp.concatenate([base.angular_jacobian, base.linear_jacobian])
        return share * self.wrench @ columns


def flying(group, turn, start):
    """A rod on a free base: 1e4 N in stretch and shear, 500 N m^2 in bending and torsion."""
    names = ("kappa_z", "sigma_x", "sigma_y")
    if group.space_dim == 3:
        names = ("kappa_x", "kappa_y", *names, "sigma_z")
    bends = ("kappa_y", "kappa_z")
    beam = rod(
        group,
        chebyshev(**{name: MODES - (name not in bends) for name in names}),
        Section(1.0, 0.05, 0.05, 0.05, 1.0),
        length=LENGTH,
        young_modulus=1e4,
        poisson_ratio=-0.5,
        density=1.0,
        nodes=NODES,
        mass_section=Section(1.0, 10.0, 10.0, 10.0, 1.0),
    )
    pose = homogeneous(jnp.array(turn), jnp.array(start))
    return assembly(group, rod=Part(beam, Free(), offset=pose))


def spaghetti():
    """The rod of Simo and Vu-Quoc (1988)."""
    return flying(SE3(), TILT, START)


def in_plane():
    """The rod of Simo and Vu-Quoc, J. Appl. Mech. 53, 1986."""
    return flying(SE2(), TILT[:2, :2], START[:2])


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


def ends(model, forces):
    """Places of both ends after 5 s."""
    options = {"step": 2e-3, "saves": 1, "every": 2500, "stepper": DormandPrince()}
    path = rollout(model, rest(model), jnp.zeros(num_dof(model)), forces, **options)
    poses = forward_kinematics(model, path.q[-1], jnp.array([0.0, 1.0]))["rod"]
    return poses[:, :-1, -1]


def independent(wrench, share, count):
    """The same by discrete elements."""
    bar = Bar(LENGTH, axial=1e4, bending=500.0, mass=1.0, rotary=10.0)

    def push(t):
        both = float(share(t)) * np.asarray(wrench)
        return both[:3], both[3:]

    return flight(bar, START, TILT, push, np.array([5.0]), count)[0]


def drift(momenta):
    """Largest change, of the angular and of the linear part, each in its own size."""
    parts = [np.asarray(momenta[:, rows]) for rows in (slice(3), slice(3, 6))]
    changes = [np.abs(p - p[0]).max() / np.linalg.norm(p[0]) for p in parts]
    return float(max(changes))


def rows():
    yield from momenta()
    count = 12 if quick("finer elements of the independent solution") else 32
    flat = (0.0, 0.0, 80.0, 8.0, 0.0, 0.0)
    for case, model, wrench, share in (
        ("in space", spaghetti(), WRENCH, rising),
        ("in the plane", in_plane(), flat, constant),
    ):
        own = wrench if case == "in space" else wrench[2:5]
        forces = (PartForce("rod", Pulse(own, share)),)
        timing = measure(ends, model, forces, repeats=2)
        found = np.asarray(jax.jit(ends)(model, forces))
        apart = found - independent(wrench, share, count)[:, : found.shape[1]]
        yield Row(
            "sorojax",
            {"dof": num_dof(model), "flight": case},
            **timing.columns(),
            error=float(np.linalg.norm(apart, axis=1).max()) / LENGTH,
            reference=INDEPENDENT,
            bar=BAR_OF_ENDS,
            bar_on="error",
        )


def momenta():
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
