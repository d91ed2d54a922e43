"""Viscoelastic rods: closed forms, order, energy, the solid, derivatives, networks."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from sorojax import SE2, SE3, fem, material, mesh, rod as R, sdf, systems as S
from sorojax.contact import LinePenalty
from sorojax.math.ode import steppers
from sorojax.math.ode.contact_midpoint import ContactMidpoint
from sorojax.math.status import Status

pytestmark = pytest.mark.quick

SHARES, TIMES = [0.5, 0.3], [0.01, 0.1]
SPECTRUM = material.Prony(SHARES, TIMES)
BRANCHES = R.Relaxation(SPECTRUM)
SOFT: dict[str, Any] = {"young_modulus": 1e6, "density": 1000.0, "length": 0.1}


def planar(poisson_ratio=0.5, **modes):
    basis = R.chebyshev(**(modes or {"kappa_z": 1}))
    return R.rod(SE2(), basis, R.circle(5e-3), poisson_ratio=poisson_ratio, **SOFT)


FINGER = planar()
TWISTED = R.rod(
    SE3(), R.chebyshev(kappa_x=1, kappa_z=1), R.circle(5e-3), poisson_ratio=0.4, **SOFT
)
STIFFNESS = float(R.stiffness_matrix(FINGER)[0, 0])
MASS = float(R.mass_matrix(FINGER, jnp.zeros(1))[0, 0])
TURN = float(R.motion(FINGER, jnp.zeros(1)).tip_jacobian[0, 0])  # of the tip per coordinate
SMALL = 1e-9  # N m, whose motion is linear
PUSH = R.TipWrench([SMALL, 0.0, 0.0])


# ---- the law


@pytest.mark.parametrize("ratio", [0.5, 0.499, 0.4, 0.0])
def test_youngs_modulus_relaxes_as_the_correspondence_principle_says(ratio):
    shear = material.Prony([0.5, 0.0, 0.2, 2.0], [1e-4, 1e-2, 0.5, 30.0])
    omega = jnp.geomspace(1e-3, 1e6, 60)

    def complex_modulus(spectrum):
        slow = material.storage_modulus(spectrum, omega)
        return np.asarray(slow) + 1j * np.asarray(material.loss_modulus(spectrum, omega))

    a = (1 - 2 * ratio) / (2 + 2 * ratio)
    exact = (1 + a) / (1 / complex_modulus(shear) + a)
    found = complex_modulus(material.uniaxial_spectrum(shear, ratio))
    assert np.abs(found / exact - 1).max() < 1e-12


def test_bending_relaxes_by_youngs_modulus_and_torsion_by_that_of_shear():
    times = jnp.concatenate([jnp.array([0.0, 1e-14]), jnp.geomspace(1e-3, 1.0, 20)])
    q = jnp.broadcast_to(jnp.array([2.0, 5.0]), (22, 2)).at[0].set(0.0)
    memory = R.branch_states(TWISTED, (BRANCHES,), times, q)
    found = -R.branch_force(TWISTED, (BRANCHES,), q, memory)[1:]
    elastic = jax.vmap(lambda q: R.elastic_force(TWISTED, q))(q[1:])
    pull = material.uniaxial_spectrum(SPECTRUM, 0.4)
    for column, spectrum in ((0, SPECTRUM), (1, pull)):
        exact = material.relaxation_modulus(spectrum, times[1:]) - 1
        error = found[:, column] / elastic[:, column] - exact
        assert float(jnp.abs(error).max()) < 1e-8
    energy = R.branch_energy(TWISTED, (BRANCHES,), q, memory)
    lost = jnp.diff(energy.stored[2:]) / jnp.diff(times[2:])
    assert bool(jnp.all(energy.stored >= 0)) and bool(jnp.all(energy.power >= 0))
    assert bool(jnp.all(lost <= 0)) and bool(jnp.all(-lost >= energy.power[3:]))


def test_a_vibration_finds_the_complex_modulus_to_second_order():
    omega = 7.0

    def force(steps):
        t = jnp.linspace(0.0, 0.9, steps + 1)
        q = jnp.sin(omega * t)[:, None]
        states = R.branch_states(FINGER, (BRANCHES,), t, q)
        return t, (
            jnp.sin(omega * t)
            - R.branch_force(FINGER, (BRANCHES,), q, states)[:, 0] / STIFFNESS
        )

    (t, coarse), (_, fine) = force(4000), force(8000)
    exact = material.storage_modulus(SPECTRUM, omega) * jnp.sin(omega * t)
    exact = exact + material.loss_modulus(SPECTRUM, omega) * jnp.cos(omega * t)
    for g, tau in zip(SHARES, TIMES, strict=True):
        exact = exact - g * omega * tau / (1 + (omega * tau) ** 2) * jnp.exp(-t / tau)
    errors = [float(jnp.abs(x - exact).max()) for x in (coarse, fine[::2])]
    assert 3.9 < errors[0] / errors[1] < 4.1
    assert float(jnp.abs((4 * fine[::2] - coarse) / 3 - exact).max()) < 1e-8


# ---- motion


def pushed(t):
    """Coordinate and memory of the linear finger, `t` [s] after it is pushed."""
    g, tau = np.array(SHARES), np.array(TIMES)
    system = np.zeros((5, 5))
    system[0, 1] = 1.0
    system[1, 0], system[1, 2:4] = -STIFFNESS * (1 + g.sum()) / MASS, STIFFNESS * g / MASS
    system[2:4, 0], system[[2, 3], [2, 3]] = 1 / tau, -1 / tau
    system[1, 4] = SMALL * TURN / MASS
    return scipy.linalg.expm(t * system)[[0, 2, 3], 4]


@pytest.mark.parametrize(
    ("stepper", "order", "steps"),
    [
        (steppers.GeneralisedAlpha(), 2, 3200),
        (steppers.ImplicitMidpoint(), 2, 3200),
        (steppers.RungeKutta4(), 4, 800),
    ],
)
def test_a_pushed_finger_creeps_as_its_linear_equations_say(stepper, order, steps):
    def end(steps):
        zero = jnp.zeros(1)
        options = {"step": 0.4 / steps, "saves": 1, "every": steps, "stepper": stepper}
        path = R.rollout(FINGER, zero, zero, (BRANCHES, PUSH), **options)
        return np.concatenate([path.q[-1], path.memory[-1, :, 0]])

    exact = pushed(0.4)
    scale = np.abs(exact).max()
    coarse, fine = end(steps), end(2 * steps)
    errors = [np.abs(x - exact).max() for x in (coarse, fine)]
    assert 0.9 * 2**order < errors[0] / errors[1] < 1.1 * 2**order
    better = fine + (fine - coarse) / (2**order - 1)
    assert np.abs(better - exact).max() < 1e-8 * scale


def test_steps_ten_times_the_shortest_time_find_the_relaxed_answer():
    fast = R.Relaxation(material.Prony([2.0], [1e-3]))
    ramp = R.TimeVaryingForce(
        lambda x: R.TipWrench([1e-3 * x, 0.0, 0.0]), lambda t: jnp.minimum(t, 1.5)
    )
    zero = jnp.zeros(1)
    path = R.rollout(FINGER, zero, zero, (fast, ramp, R.Damping(0.02)), step=1e-2, saves=250)
    load = 1e-3 * TURN * jnp.minimum(path.time, 1.5)
    even = (path.time > 0.5) & (jnp.abs(path.time - 1.5) > 0.1)
    slow = load / STIFFNESS - jnp.where(path.time < 1.5, 0.022 * 1e-3 * TURN / STIFFNESS, 0.0)
    assert path.status == Status.successful
    assert float(jnp.abs(path.q[:, 0] / slow - 1)[even].max()) < 0.01
    rest = R.equilibrium(FINGER, (fast, R.TipWrench([1.5e-3, 0.0, 0.0]))).q
    assert float(jnp.abs(path.q[-1] / rest - 1)[0]) < 1e-6


def test_a_swing_loses_what_the_branches_take():
    finger, q = planar(0.4, kappa_z=2, sigma_x=1), jnp.array([20.0, -5.0, 0.02])
    ends = []
    for steps in (400, 800):
        path = R.rollout(finger, q, 0 * q, (BRANCHES,), step=0.2 / steps, saves=steps)
        energy = R.branch_energy(finger, (BRANCHES,), path.q, path.memory)
        moving = jax.vmap(lambda q, v: R.kinetic_energy(finger, q, v))(path.q, path.v)
        elastic = jax.vmap(lambda q: R.potential_energy(finger, q))(path.q)
        power = (energy.power[1:] + energy.power[:-1]) / 2
        taken = jnp.cumsum(power) * 0.2 / steps
        assert bool(jnp.all(energy.power >= 0)) and bool(jnp.all(energy.stored >= 0))
        balance = (moving + elastic + energy.stored)[1:] + taken
        ends.append(float(jnp.abs(balance / elastic[0] - 1).max()))
    assert float(taken[-1] / elastic[0]) > 0.5
    assert ends[1] < 0.02 and ends[0] > 2 * ends[1], ends


@functools.cache
def solid_and_rod():
    """A slender solid in plane stress under a force at its end, and its rod."""
    grid = mesh.enrich(mesh.rectangle([0, 0], [0.1, 4e-3], divisions=(4, 1), order=2))
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1000.0)
    solid = material.Viscoelastic(rubber, SPECTRUM)
    problem = fem.problem(
        grid,
        solid,
        kinematics=fem.PlaneStress(4e-3),
        supports=(
            fem.Fixed(grid.node_sets["left"], components=(0,)),
            fem.Fixed(np.array([mesh.nearest_node(grid, [0.0, 2e-3])]), components=(1,)),
        ),
        loads=(fem.Force(grid.node_sets["right"], [0.0, 0.0], name="push"),),
    )
    finger = R.rod(
        SE2(),
        R.chebyshev(kappa_z=1, sigma_x=1),
        R.rectangle(4e-3, 4e-3),
        R.elastic(solid),
        length=0.1,
    )
    return problem, finger


@pytest.mark.parametrize("way", ["bent", "pulled"])
def test_a_rod_and_its_solid_relax_alike(way):
    """What the solid does under a force that is held, the rod bears with that force."""
    problem, finger = solid_and_rod()
    times = jnp.concatenate(
        [jnp.array([0.0, 1e-12]), 0.5 * jnp.linspace(0.0, 1.0, 25)[1:] ** 2]
    )
    axis = 0 if way == "pulled" else 1
    push = jnp.zeros((len(times), 2)).at[1:, axis].set(1e-6)
    path = fem.solve_path(problem, times=times, push=push)
    moved = path.displacements[:, mesh.nearest_node(problem.mesh, [0.1, 2e-3]), axis]
    q = jnp.zeros((len(times), 2)).at[:, 1 - axis].set(moved / moved[-1])
    memory = R.branch_states(finger, (BRANCHES,), times, q)
    column = 1 - axis
    stiffness = R.stiffness_matrix(finger)[column, column]
    borne = q - R.branch_force(finger, (BRANCHES,), q, memory) / stiffness
    held = borne[1:, column]
    pull = material.uniaxial_spectrum(SPECTRUM, 0.4)
    stiff = float(material.relaxation_modulus(pull, 0.0))
    assert abs(float(moved[-1] / moved[1]) / stiff - 1) < 0.1  # it crept for its longest time
    assert float(jnp.abs(held / held[0] - 1).max()) < 5e-4
    wrong = R.branch_force(
        finger, (BRANCHES, R.LinearElastic(R.stiffness_matrix(finger))), q, memory
    )
    wrong = (q - wrong / stiffness)[1:, column]
    assert float(jnp.abs(wrong / held[0] - 1).max()) > 0.02  # by the shear modulus


def test_gradients_by_every_constant_through_200_steps():
    """Shares, times, modulus and Poisson's ratio, against differences of fourth order."""
    finger, q = planar(0.4, kappa_z=1, sigma_x=1), jnp.array([20.0, 0.02])

    def way(theta):
        spectrum = material.Prony(0.5 * theta[:2], 0.01 * theta[2:4])
        given = dataclasses.replace(
            finger, material=R.Elastic(1e6 * theta[4], 0.4 * theta[5], 1000.0)
        )
        forces = (R.Relaxation(spectrum), R.Gravity())
        path = R.rollout(given, q, 0 * q, forces, step=1e-3, saves=2, every=100, check=False)
        energy = R.branch_energy(given, forces, path.q, path.memory)
        return path.q[-1, 0] + 1e3 * jnp.sum(energy.stored)

    way = jax.jit(way)
    theta = jnp.array([1.0, 0.6, 0.3, 2.0, 1.0, 1.0])
    slope = np.asarray(jax.grad(way)(theta))
    for k in range(6):
        d = jnp.zeros(6).at[k].set(2e-3 * float(theta[k]))
        change = [float(way(theta + n * d) - way(theta - n * d)) for n in (1, 2)]
        assert np.isclose(slope[k], (8 * change[0] - change[1]) / (12 * d[k]), rtol=1e-6)


def test_lanes_of_vmap_are_runs_of_their_own():
    def end(share):
        forces = (R.Relaxation(material.Prony([share, 0.3], TIMES)), R.Gravity())
        return R.rollout(FINGER, jnp.ones(1), jnp.zeros(1), forces, step=1e-3, saves=20).q[-1]

    shares = jnp.array([0.2, 0.9])
    alone = jnp.stack([end(share) for share in shares])
    assert float(jnp.abs(jax.vmap(end)(shares) / alone - 1).max()) < 1e-12


def test_a_run_in_two_parts_has_the_bits_of_the_whole():
    q, options = jnp.ones(1), {"step": 1e-3, "stepper": steppers.RungeKutta4(), "check": False}
    whole = R.rollout(FINGER, q, 0 * q, (BRANCHES,), saves=20, **options)
    first = R.rollout(FINGER, q, 0 * q, (BRANCHES,), saves=10, **options)
    q, v, memory = first.q[-1], first.v[-1], first.memory[-1]
    second = R.rollout(FINGER, q, v, (BRANCHES,), saves=10, memory=memory, **options)
    assert jnp.array_equal(second.q[-1], whole.q[-1])
    assert jnp.array_equal(second.memory[-1], whole.memory[-1])


def test_without_branches_nothing_is_added():
    zero = jnp.zeros(1)
    problem = R.second_order(FINGER, zero, (R.Gravity(), R.Damping(0.01)))
    begun = steppers.start(problem, 0.0, zero, zero)
    assert problem.memory is None and begun.memory is None
    assert steppers.within(problem, 1e-3, begun) is problem
    assert R.rollout(FINGER, zero, zero, step=1e-3, saves=2).memory is None
    assert set(S.RodBody(FINGER).initial_state()) == {"q", "v"}


# ---- laws, assemblies, networks, contact


def test_a_law_in_place_of_the_rods_own_relaxes_by_its_slope_at_rest():
    law = R.section_law(TWISTED, lambda strain, s: 1e-4 * (strain + strain**3))
    q, memory = jnp.array([2.0, 5.0]), jnp.zeros((2, 2))
    found = R.branch_force(TWISTED, (BRANCHES, law), q, memory)
    assert jnp.allclose(found, -0.8 * jax.jacfwd(law.restoring_force)(0 * q) @ q, rtol=1e-12)


def test_each_rod_of_an_assembly_has_branches_of_its_own():
    tree = R.serial(FINGER, FINGER, joint=R.Revolute([0.0, 0.0, 1.0], stiffness=1e-3))
    other = R.Relaxation(material.Prony([0.7], [0.02]))
    forces = (R.PartForce("segment_0", BRANCHES), R.PartForce("segment_1", other))
    x, memory = jnp.array([3.0, 1.0, 2.0]), jnp.zeros((2, 3))
    found = R.branch_force(tree, forces, x, memory)
    assert jnp.allclose(found, -STIFFNESS * jnp.array([0.0, 0.8 * 1.0, 0.7 * 2.0]), rtol=1e-12)
    exact = R.rollout(tree, x, 0 * x, forces, step=2.5e-4, saves=2, every=100)
    body = S.AssemblyBody(tree, forces, q=x)
    film = S.simulate(S.Network({"tree": body}, {}), 0.05, save=3, rtol=1e-7, atol=1e-9)
    for name in ("q", "memory"):
        ends = film.state["tree"][name][-1], getattr(exact, name)[-1]
        assert float(jnp.abs(ends[0] - ends[1]).max()) < 5e-3 * float(jnp.abs(ends[1]).max())


def test_a_rod_in_a_network_moves_as_in_a_rollout():
    forces = (BRANCHES, R.Gravity())
    film = S.simulate(
        S.Network({"rod": S.RodBody(FINGER, forces)}, {}), 0.1, save=2, rtol=1e-9, atol=1e-11
    )
    zero, fine = jnp.zeros(1), {"step": 2.5e-4, "saves": 1, "every": 400}
    path = R.rollout(FINGER, zero, zero, forces, stepper=steppers.RungeKutta4(), **fine)
    for name in ("q", "memory"):
        ends = film.state["rod"][name][-1], getattr(path, name)[-1]
        assert jnp.allclose(*ends, rtol=1e-6)


def test_a_finger_on_the_floor_relaxes_to_its_equilibrium():
    law = LinePenalty(1e4, 1e-4, friction=0.1)

    def floor(height):
        shape = sdf.HalfPlane([0.0, height], [0.0, 1.0])
        return (BRANCHES, R.Gravity(), R.Damping(0.05), R.ObstacleContact(shape, 5e-3, law))

    zero, options = jnp.zeros(1), {"stepper": ContactMidpoint(), "step": 2e-3}
    path = R.rollout(FINGER, zero, zero, floor(-9e-3), saves=2, every=400, **options)
    rest = R.equilibrium(FINGER, floor(-9e-3)).q
    free = R.equilibrium(FINGER, floor(-1.0)).q
    assert path.status == Status.successful
    assert abs(float(rest[0])) < 0.7 * abs(float(free[0]))
    assert float(jnp.abs(path.q[-1] / rest - 1)[0]) < 1e-2
    assert float(jnp.abs(path.memory[-1] / rest[None] - 1).max()) < 2e-2
    far = R.rollout(FINGER, zero, zero, floor(-1.0), saves=2, every=400, **options)
    plain = floor(-1.0)[:3]
    options["stepper"] = steppers.ImplicitMidpoint()
    apart = R.rollout(FINGER, zero, zero, plain, saves=2, every=400, **options)
    assert jnp.allclose(far.q, apart.q, rtol=1e-9) and jnp.allclose(far.memory, apart.memory)


ZERO = jnp.zeros(1)
STEPS = {"step": 1e-3, "saves": 1}


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: R.forward_dynamics(FINGER, ZERO, ZERO, (BRANCHES,)), "carries its memory"),
        (
            lambda: R.rollout(
                FINGER, ZERO, ZERO, (BRANCHES,), stepper=steppers.TripleJump(), **STEPS
            ),
            "Take ImplicitMidpoint",
        ),
        (lambda: R.rollout(FINGER, ZERO, ZERO, (BRANCHES, BRANCHES), **STEPS), "one spectrum"),
        (lambda: R.rollout(FINGER, ZERO, ZERO, memory=ZERO[None], **STEPS), "no Relaxation"),
        (
            lambda: R.rollout(FINGER, ZERO, ZERO, (BRANCHES,), memory=ZERO[None], **STEPS),
            "one row per branch",
        ),
        (
            lambda: R.rollout(FINGER, ZERO, ZERO, (R.PartForce("a", BRANCHES),), **STEPS),
            "take the name off",
        ),
        (lambda: R.branch_states(FINGER, (), jnp.arange(2.0), jnp.zeros((2, 1))), "need one"),
        (lambda: R.Relaxation(material.Prony([np.ones(3)], [0.1])), "one number per branch"),
        (lambda: material.uniaxial_spectrum(SPECTRUM, 0.6), "poisson_ratio"),
    ],
)
def test_what_is_not_carried_is_refused(call, says):
    with pytest.raises((ValueError, TypeError), match=says):
        call()
