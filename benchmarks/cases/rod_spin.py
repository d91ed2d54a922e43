"""Spin-up of a flexible arm whose base is driven, after Simo and Vu-Quoc (1986).

The reference is a chain of small-strain planar beam finite elements of our own, with linear
shape functions and one-point integration, stepped by generalised-alpha in NumPy. PyElastica
turns the first element of its rod.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, measure, quick
from sorojax import rod
from sorojax.math.lie import SE2, homogeneous, plane_rotation
from sorojax.math.ode.steppers import GeneralisedAlpha

STRETCH, BENDING, SHEAR = 2.8e7, 1.4e4, 1e7  # N, N m^2, N
MASS, ROTARY, LENGTH = 1.2, 6e-4, 10.0  # kg/m, kg m, m
RISE, SPEED, END = 15.0, 6.0, 20.0  # s, rad/s, s
EXTENSION = 5.14e-4  # m, steady, of the paper
BAR = 5e-3
ELASTICA = 20, 40  # elements, at 0.9 of the step that the stiffest mode can bear
REFERENCE = "deflection of the tip over time, FEM; steady extension, closed form"


def angle(t):
    """Of the base [rad]."""
    turn = 2 * np.pi / RISE
    rising = SPEED / RISE * (t**2 / 2 + (jnp.cos(turn * t) - 1) / turn**2)
    return jnp.where(t < RISE, rising, SPEED * t - SPEED * RISE / 2)


class SpinUp(eqx.Module):
    """Pose of the base in time; a module, so that `jax.jit` takes a model that holds it."""

    def __call__(self, t):
        return homogeneous(plane_rotation(angle(t)), jnp.zeros(2))


def arm():
    """The arm on a free base, which a closure drives."""
    beam = rod.rod(
        SE2(),
        rod.chebyshev(kappa_z=4, sigma_x=3, sigma_y=2),
        rod.Section(STRETCH, BENDING, BENDING, BENDING, SHEAR / STRETCH),
        length=LENGTH,
        young_modulus=1.0,
        poisson_ratio=-0.5,  # shear modulus 1 too
        density=1.0,
        nodes=10,
        mass_section=rod.Section(MASS, ROTARY, ROTARY, ROTARY, 1.0),
    )
    tree = rod.assembly(SE2(), arm=rod.Part(beam, rod.Free()))
    return rod.with_closures(tree, base=rod.Closure("arm", at=0.0, motion=SpinUp()))


def spin(model, step):
    """Time, and displacement of the tip along the axes of the base [m], every 50 ms."""
    path = rod.rollout(
        model,
        rod.rest(model),
        jnp.zeros(rod.num_dof(model)),
        step=step,
        saves=round(END / 0.05),
        every=round(0.05 / step),
        stepper=GeneralisedAlpha(0.8),
        check=False,
    )
    tips = jax.vmap(lambda q: rod.tip_pose(model, q)["arm"][:2, 2])(path.q)
    return path.time, seen(path.time, tips)


def seen(time, tips):
    """Displacements from the unstrained arm, along the axes of the base."""
    turn = plane_rotation(angle(jnp.asarray(time)))
    return jnp.einsum("tji,tj->ti", turn, jnp.asarray(tips)) - jnp.array([[LENGTH, 0.0]])


class Elements:
    """Forces and tangent of a chain of Reissner's beam elements, x, y, angle per node."""

    def __init__(self, count):
        self.size = LENGTH / count
        self.rows = 3 * np.arange(count)[:, None] + np.arange(6)[None]
        self.law = np.array([STRETCH, SHEAR, BENDING])
        pair, self.mass = (
            np.array([[2, 1], [1, 2]]) / 6 * self.size,
            np.zeros((3 * count + 3,) * 2),
        )
        for row in self.rows:
            own = np.kron(pair, np.diag([MASS, MASS, ROTARY]))
            self.mass[np.ix_(row, row)] += own

    def forces(self, x):
        """Inner forces and their tangent."""
        own, h = x[self.rows], self.size
        turn = (own[:, 2] + own[:, 5]) / 2
        c, s, o = np.cos(turn), np.sin(turn), np.zeros_like(turn)
        dx, dy = ((own[:, k + 3] - own[:, k]) / h for k in (0, 1))
        along, across = c * dx + s * dy, c * dy - s * dx
        strain = np.stack([along - 1, across, (own[:, 5] - own[:, 2]) / h])
        load = self.law[:, None] * strain
        slope = np.array(
            [
                [-c / h, -s / h, across / 2, c / h, s / h, across / 2],
                [s / h, -c / h, -along / 2, -s / h, c / h, -along / 2],
                [o, o, o - 1 / h, o, o, o + 1 / h],
            ]
        )
        force, tangent = np.zeros(x.size), np.zeros((x.size,) * 2)
        np.add.at(force, self.rows, h * np.einsum("ae,ane->en", load, slope))
        bend = np.zeros((len(o), 6, 6))
        # by position and angle: N c' and so on; by angle twice
        first, second = load[0] / (2 * h), load[1] / (2 * h)
        cross = np.stack([first * s + second * c, second * s - first * c])
        for place, sign in ((0, 1), (3, -1)):
            for k in (0, 1):
                for t in (2, 5):
                    bend[:, place + k, t] = bend[:, t, place + k] = sign * cross[k]
        twice = -(load[0] * along + load[1] * across) / 4
        for t in (2, 5):
            for u in (2, 5):
                bend[:, t, u] = twice
        inner = np.einsum("ane,a,ame->enm", slope, self.law, slope)
        np.add.at(tangent, (self.rows[:, :, None], self.rows[:, None]), h * (inner + bend))
        return force, tangent


def elements(count, h, end=END):
    """Tip of the chain every 50 ms, by generalised-alpha (0.8) with the base turned."""
    chain = Elements(count)
    x = np.zeros(3 * count + 3)
    x[0::3] = np.linspace(0, LENGTH, count + 1)
    v, a, free = np.zeros_like(x), np.zeros_like(x), slice(3, None)
    rho = 0.8
    am, af = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    gamma = 1 / 2 + af - am
    beta = (gamma + 1 / 2) ** 2 / 4
    times = h * np.arange(round(end / h) + 1)
    turns = np.asarray(angle(jnp.asarray(times)))
    tips, every = [x[-3:-1].copy()], round(0.05 / h)
    for n in range(1, len(times)):
        new = a.copy()
        leap, surge = x + h * v + h * h * (1 / 2 - beta) * a, v + h * (1 - gamma) * a
        new[2] = (turns[n] - leap[2]) / (beta * h * h)
        for _ in range(3):
            middle = (1 - af) * (leap + beta * h * h * new) + af * x
            force, tangent = chain.forces(middle)
            left = chain.mass @ ((1 - am) * new + am * a) + force
            matrix = (1 - am) * chain.mass + (1 - af) * beta * h * h * tangent
            new[free] -= np.linalg.solve(matrix[free, free], left[free])
        x, v, a = leap + beta * h * h * new, surge + gamma * h * new, new
        if n % every == 0:
            tips.append(x[-3:-1].copy())
    return np.array(tips)


def rows():
    model = arm()
    timing = measure(lambda model: spin(model, 5e-3), model, repeats=2)
    run = jax.jit(spin, static_argnums=1)
    time, found = run(model, 5e-3)
    _, finer = run(model, 2.5e-3)
    want = seen(time, elements(40, 5e-3))
    size = float(jnp.max(jnp.abs(want[:, 1])))
    late = np.asarray(time) > 18.0  # extension after the rise, but for what still vibrates
    steady = MASS * SPEED**2 * LENGTH**3 / (3 * STRETCH)
    errors = {
        "deflection over FEM": float(jnp.max(jnp.abs((found - want)[:, 1]))) / size,
        "deflection over half steps": float(jnp.max(jnp.abs((found - finer)[:, 1]))) / size,
        "steady extension": abs(float(jnp.mean(found[late, 0])) / steady - 1),
    }
    for what, error in errors.items():
        yield Row(
            "sorojax",
            {"of": what, "dof": rod.num_dof(model), "largest deflection (m)": size},
            **timing.columns(),
            error=error,
            reference=REFERENCE,
            bar=BAR,
            bar_on="error",
        )
    for pieces in ELASTICA[: 1 if quick("peers but with 20 elements") else None]:
        yield peers.row(
            "pyelastica",
            "spin",
            {
                "bar": np.array([LENGTH, STRETCH, SHEAR, BENDING, MASS, ROTARY]),
                "turn": np.array([RISE, SPEED]),
            },
            lambda answer: float(
                jnp.max(jnp.abs((seen(time, answer["tips"]) - want)[:, 1])) / size
            ),
            REFERENCE,
            elements=pieces,
            share=0.9,
            of="deflection over FEM",
            duration=END,
            save_dt=0.05,
            repeats=1,
        )
