"""Held and closed rods of the literature: Lee's frame on two pins, Goto's ring folded to a
third, Michell's twisted ring, a roll-up into ten turns with a force out of plane."""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from benchmarks.harness import Row, measure_once, quick
from sorojax import SE2, SE3, rod as R
from sorojax.math.lie import homogeneous, plane_rotation

EVERY = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")
BAR = 5e-3


def bases(count, names):
    return R.chebyshev(**{name: count for name in names})


def turned(angle, *position):
    return homogeneous(plane_rotation(jnp.asarray(angle)), jnp.array(position, float))


# Lee, Manuel, Rossow, J. Eng. Mech. Div. 94, 1968; lengths in those of the column


LIMIT = 18.552  # P L^2 / (E I)
SLENDER = 43200 / 2  # A L^2 / I of L = 120, A = 6, I = 2


def frame(modes):
    """A column and a beam on pins, in two parts where the load is."""

    def part(length):
        section = R.Section(1.0, 1 / SLENDER, 1 / SLENDER, 2 / SLENDER, 1.0)
        return R.rod(
            SE2(),
            R.chebyshev(kappa_z=modes, sigma_x=3),
            section,
            length=length,
            young_modulus=SLENDER,
            poisson_ratio=0.0,
            density=1.0,
        )

    whole = R.assembly(
        SE2(),
        column=R.Part(part(1.0), R.Revolute(), offset=turned(np.pi / 2, 0.0, 0.0)),
        near=R.Part(part(0.2), on="column", offset=turned(-np.pi / 2, 0.0, 0.0)),
        far=R.Part(part(0.8), on="near"),
    )
    return R.with_closures(
        whole, pin=R.Closure("far", R.Revolute(), offset=turned(0.0, 1.0, 1.0))
    )


def pressed(factor):
    return (R.PartForce("near", R.TipWrench(factor * jnp.array([0.0, 0.0, -1.0]))),)


def snap(model):
    return R.arc_length_path(model, pressed, first=2.0, steps=60, longest=1.0)


def peak(path):
    """The largest load, by the parabola through the three states about it."""
    factors = np.asarray(path.factors)
    k = int(np.argmax(factors))
    before, at, after = factors[k - 1 : k + 2]
    return float(at - (after - before) ** 2 / (8 * (after - 2 * at + before)))


# Goto, Watanabe, Kasugai, Obata, Int. J. Solids Structures 29, 1992: half of the ring, its
# far end turned about the diameter and free to slide along it


RADIUS = 20.0


def about_y(t):
    c, s, o, i = jnp.cos(t), jnp.sin(t), jnp.zeros_like(t), jnp.ones_like(t)
    return jnp.array([[c, o, s, o], [o, i, o, o], [-s, o, c, o], [o, o, o, i]])


def half_ring(modes):
    half = R.rod(
        SE3(),
        bases(modes, EVERY[:3]),
        R.rectangle(1.0, 1 / 3),
        length=np.pi * RADIUS,
        young_modulus=2.1e7,
        poisson_ratio=0.3,
        density=1.0,
        rest_strain=[0, 0, 1 / RADIUS, 1, 0, 0],
        nodes=4 * modes,
    )
    pose = R.tip_pose(half, R.rest(half))
    place = jnp.eye(4).at[:3, 3].set(pose[:3, 3])
    axes = jnp.eye(4).at[:3, :3].set(pose[:3, :3].T)
    closure = R.Closure("rod", R.Prismatic([0, 1, 0]), offset=place, frame=axes, motion=about_y)
    return R.with_closures(half, turned=closure)


def unloaded(_):
    return ()


def same(factor):
    return factor


def fold(ring, steps=40):
    angles = jnp.linspace(0, 2 * np.pi, steps + 1)[1:]
    return R.equilibrium_path(ring, unloaded, angles, t=same)


# Michell, Messenger of Mathematics 11, 1889: a straight rod bent to a ring, its ends turned
# against each other; out of plane it goes at a twist of 2 pi sqrt(3) E I / (G J)


def about_x(t):
    c, s, o, i = jnp.cos(t), jnp.sin(t), jnp.zeros_like(t), jnp.ones_like(t)
    return jnp.array([[i, o, o, o], [o, c, -s, o], [o, s, c, o], [o, o, o, i]])


def twisted(modes, ratio):
    ring = R.rod(
        SE3(),
        bases(modes, EVERY[:3]),
        R.circle(0.01),
        length=2 * np.pi,
        young_modulus=1e6,
        poisson_ratio=ratio,
        density=1.0,
        nodes=3 * modes,
    )
    # in its plane, as a ring of no own curvature turns about its tangent without energy
    far = R.Closure("rod", R.Roller([0, 1, 0]), at=0.5, offset=jnp.eye(4).at[1, 3].set(2.0))
    seam = R.Closure("rod", on="rod", s=0.0, motion=about_x)
    return R.with_closures(ring, seam=seam, far=far)


# the search goes no further than some 0.05 rad of twist, and larger steps are tried and cut
SHARES = np.concatenate([0.004 * np.arange(1, 246), np.arange(0.983, 1.017, 0.002)])


def twist(ring, twists):
    modes = R.num_dof(ring) // 3
    start = jnp.zeros(3 * modes).at[2 * modes].set(1.0)
    return R.equilibrium_path(ring, unloaded, twists, start, t=same)


def critical(path):
    """Half way between the last stable twist and the first unstable one, of twists 0.2 % of
    the closed form apart."""
    first = int(np.argmax(np.asarray(path.negative_eigenvalues) > 0))
    return (SHARES[first - 1] + SHARES[first]) / 2 if first else float("nan")


# Ibrahimbegovic, CMAME 149, 1997


LENGTH, STIFF, LONG = 10.0, 100.0, 1e4
MOMENT, ACROSS = 200 * np.pi, 50.0


def roll(modes):
    return R.rod(
        SE3(),
        bases(modes, EVERY),
        R.Section(1.0, 0.01, 0.01, 0.02, 1.0),
        length=LENGTH,
        young_modulus=LONG,
        poisson_ratio=-0.5,
        density=1.0,
        nodes=3 * modes,
    )


def rolled(factor):
    return (R.TipWrench(factor * jnp.array([0, 0, MOMENT, 0, 0, ACROSS])),)


def load(model, factors):
    return R.equilibrium_path(model, rolled, factors)


def shot(factor, guess):
    """The tip by shooting: the equations of the rod in s, integrated from the clamp."""
    force, moment = factor * np.array([0, 0, ACROSS]), factor * np.array([0, 0, MOMENT])

    def ahead(tip):
        def rate(_, state):
            turn = state[3:] / np.linalg.norm(state[3:])
            axes = Rotation.from_quat(turn).as_matrix()
            bend = (moment + np.cross(tip - state[:3], force)) / STIFF
            spin = np.append(bend, 0.0)
            x, y, z, w = turn
            left = np.array([[w, z, -y, x], [-z, w, x, y], [y, -x, w, z], [-x, -y, -z, w]])
            stretch = np.array([1.0, 0, 0]) + axes.T @ force / LONG
            return np.concatenate([axes @ stretch, left @ spin / 2])

        start = np.array([0, 0, 0, 0, 0, 0, 1.0])
        end = solve_ivp(rate, (0, LENGTH), start, rtol=1e-10, atol=1e-12, method="DOP853")
        return end.y[:3, -1] - tip

    return root(ahead, guess, tol=1e-10).x


def rows():
    few = quick("more modes, the roll-up beyond half of its load")
    for modes in (4,) if few else (4, 6):
        timing, path = measure_once(snap, frame(modes))
        error = abs(peak(path) / LIMIT - 1)
        yield _row("Lee's frame", modes, timing, error, "first limit load 18.552 E I / L^2")
    for modes in (5,) if few else (5, 8):
        model = half_ring(modes)
        timing, path = measure_once(fold, model)
        across = float(R.tip_pose(model, path.q[-1])["rod"][1, 3])
        error = abs(across / (2 * RADIUS / 3) - 1)
        yield _row("Goto's ring", modes, timing, error, "radius / 3 after a whole turn")
    for ratio, modes in ((0.0, 13),) if few else ((0.0, 13), (0.5, 17)):
        twists = jnp.asarray(2 * np.pi * np.sqrt(3) * (1 + ratio) * SHARES)
        timing, path = measure_once(twist, twisted(modes, ratio), twists)
        error = abs(critical(path) - 1)
        case = f"Michell's ring, Poisson ratio {ratio}"
        yield _row(case, modes, timing, error, "critical twist 2 pi sqrt(3) E I / (G J)")
    for share, modes in ((0.5, 16),) if few else ((0.5, 16), (1.0, 24)):
        factors = jnp.linspace(0, share, round(100 * share) + 1)[1:]
        timing, path = measure_once(load, roll(modes), factors)
        tip = np.asarray(R.tip_pose(roll(modes), path.q[-1])[:3, 3])
        error = float(np.linalg.norm(tip - shot(share, tip))) / LENGTH
        case = f"roll-up into {round(10 * share)} turns"
        yield _row(
            case, modes, timing, error, "tip by shooting (SciPy), relative to the length"
        )


def _row(case, modes, timing, error, reference):
    return Row(
        "sorojax",
        {"case": case, "modes": modes},
        **timing.columns(),
        error=error,
        reference=reference,
        bar=BAR,
        bar_on="error",
    )
