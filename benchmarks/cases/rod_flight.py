"""A flexible rod in free flight, in space and in the plane: momentum after a pulse of force
and moment on one end, and its ends beside an independent solution and PyElastica."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
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
FINER = (4, 12), (6, 14), (10, 24)  # modes, nodes
ELASTICA = 20, 40, 80, 160  # elements, at half of the step that the stiffest mode can bear
FLAT = (0.0, 0.0, 80.0, 8.0, 0.0, 0.0)
NUMBERS = dict(axial=1e4, bending=500.0, mass=1.0, rotary=10.0)
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


def flying(group, turn, start, modes=MODES, nodes=NODES):
    """A rod on a free base: 1e4 N in stretch and shear, 500 N m^2 in bending and torsion."""
    names = ("kappa_z", "sigma_x", "sigma_y")
    if group.space_dim == 3:
        names = ("kappa_x", "kappa_y", *names, "sigma_z")
    bends = ("kappa_y", "kappa_z")
    beam = rod(
        group,
        chebyshev(**{name: modes - (name not in bends) for name in names}),
        Section(1.0, 0.05, 0.05, 0.05, 1.0),
        length=LENGTH,
        young_modulus=1e4,
        poisson_ratio=-0.5,
        density=1.0,
        nodes=nodes,
        mass_section=Section(1.0, 10.0, 10.0, 10.0, 1.0),
    )
    pose = homogeneous(jnp.array(turn), jnp.array(start))
    return assembly(group, rod=Part(beam, Free(), offset=pose))


def spaghetti(**size):
    """The rod of Simo and Vu-Quoc (1988)."""
    return flying(SE3(), TILT, START, **size)


def in_plane(**size):
    """The rod of Simo and Vu-Quoc, J. Appl. Mech. 53, 1986."""
    return flying(SE2(), TILT[:2, :2], START[:2], **size)


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
    bar = Bar(LENGTH, **NUMBERS)

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
    some = slice(1) if quick("finer rods than of 4 modes or 20 elements") else slice(None)
    count = 12 if quick("finer elements of the independent solution") else 32
    for case, make, wrench, share in (
        ("in space", spaghetti, WRENCH, rising),
        ("in the plane", in_plane, FLAT, constant),
    ):
        want = independent(wrench, share, count)
        own = wrench if case == "in space" else wrench[2:5]
        forces = (PartForce("rod", Pulse(own, share)),)
        for modes, nodes in FINER[some]:
            model = make(modes=modes, nodes=nodes)
            timing = measure(ends, model, forces, repeats=2)
            yield Row(
                "sorojax",
                {"dof": num_dof(model), "flight": case},
                **timing.columns(),
                error=apart(jax.jit(ends)(model, forces), want),
                reference=INDEPENDENT,
                bar=BAR_OF_ENDS,
                bar_on="error",
            )
        for elements in ELASTICA[some]:
            yield elastica(case, wrench, share, want, elements)


def apart(found, want):
    """Of the ends, by the length; in the plane two coordinates."""
    found = np.asarray(found)
    return float(np.linalg.norm(found - want[:, : found.shape[1]], axis=1).max()) / LENGTH


def elastica(case, wrench, share, want, elements):
    """The same rod in PyElastica, whose section shrinks as it stretches."""
    knots = np.array([0.0, PEAK - 1e-9, PEAK, END])
    stiffness, inertia = ("axial", "axial", "bending"), ("mass", "rotary")
    arrays = {
        "bar": np.array([LENGTH, *(NUMBERS[k] for k in stiffness + inertia)]),
        "base": START,
        "axes": TILT,
        "wrench": np.array(wrench),
        "times": knots,
        "shares": np.asarray(share(knots)),
    }
    return peers.row(
        "pyelastica",
        "flight",
        arrays,
        lambda answer: apart(answer["ends"][-1], want),
        INDEPENDENT,
        elements=elements,
        share=0.5,
        flight=case,
        duration=END,
        save_dt=END,
        repeats=3,
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
