"""Rods of the printable robots: their cells in closed form, their places, their board."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.optimize import minimize_scalar

from sorojax import material, robots, rod as R, sdf
from sorojax.math.lie import SE2, SE3
from sorojax.robots.models import cell as models_cells
from sorojax.robots.models.cell import Cell
from sorojax.robots.models.rods import body, column, side_by_side
from sorojax.robots.printable import LaidAlong
from sorojax.units import kPa, mm
from sorojax_board.bench import STEP
from sorojax_hardware import LocalBoard, SimulatedClock, run_loop, simulated

RUBBER = robots.printed_rubber()
CELL = Cell(
    stiffness=[[400.0, -1.5, 0.0], [-1.5, 0.016, 0.0], [0.0, 0.0, 0.004]],
    push=[1.2e-4, 2e-7, 0.0],
    gas=1e-4,
    compliance=1e-9,
    solid=1e-4,
    second_moments=[3e-9, 2e-9],
    center=[-1.5 * mm, 0.0],
)


@pytest.fixture
def quick(monkeypatch):
    """Robots whose cells need not be solved."""
    monkeypatch.setattr(models_cells, "unit_cell", lambda *_, **__: CELL)


@pytest.fixture(scope="module")
def tube():
    """A tube of rubber, its cell, the areas of wall and hole."""
    inner, outer = 5 * mm, 8 * mm
    air = LaidAlong(sdf.Cylinder(inner, 100 * mm), 0)
    body = LaidAlong(sdf.Cylinder(outer, 100 * mm), 0) - air
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
    cell = robots.unit_cell(body, air, (0.0, 6 * mm), rubber, size=1.5 * mm, mirrors=(1, 2))
    return rubber, cell, np.pi * (outer**2 - inner**2), np.pi * inner**2


def test_the_cell_of_a_tube_is_that_of_lame(tube):
    inner, outer, young, ratio = 5 * mm, 8 * mm, 1e6, 0.45
    _, cell, area, hole = tube
    moment = np.pi / 4 * (outer**4 - inner**4)
    want = young * np.array([area, moment, moment])
    assert np.allclose(np.diag(cell.stiffness), want, rtol=1e-3)
    assert np.allclose(
        cell.stiffness - np.diag(np.diag(cell.stiffness)), 0, atol=1e-9 * want[0]
    )
    # held at its ends, the wall under pressure pushes with nu (sigma_r + sigma_t)
    assert cell.push[0] == pytest.approx(hole * (1 - 2 * ratio), rel=1e-3)
    assert np.array_equal(cell.push[1:], [0, 0])
    bulge = inner * (1 + ratio) / young / (outer**2 - inner**2)
    bulge *= (1 - 2 * ratio) * inner**2 + outer**2
    assert cell.compliance == pytest.approx(2 * np.pi * inner * bulge, rel=1e-2)
    assert cell.gas == pytest.approx(hole, rel=1e-3)
    assert cell.solid == pytest.approx(area, rel=1e-3)
    assert np.allclose(cell.second_moments, moment, rtol=1e-3)


def test_the_tube_at_large_strains_is_that_of_a_uniform_stretch(tube):
    """Derivatives in the stretch of force and volume, the wall as wide as it wants to be."""
    rubber, cell, area, hole = tube
    shear, bulk = (float(m) for m in material.small_strain_moduli(rubber))

    def energy(e, wide):
        J = (1 + e) * wide**2
        first = J ** (-2 / 3) * ((1 + e) ** 2 + 2 * wide**2)
        return shear / 2 * (first - 3) + bulk / 2 * (J - 1) ** 2

    e = 0.1 * np.cos(np.linspace(0, np.pi, 13))
    wide = np.array(
        [minimize_scalar(functools.partial(energy, x), (0.9, 1.1), tol=1e-13).x for x in e]
    )

    def derivatives(values):
        fit = Polynomial.fit(e, values, 12)
        return [float(fit.deriv(k)(0.0)) for k in range(5)]

    stored = derivatives(area * energy(e, wide))
    volume = derivatives(hole * (1 + e) * wide**2)
    assert float(cell.third[0]) == pytest.approx(stored[3], rel=2e-3)
    assert float(cell.fourth[0]) == pytest.approx(stored[4], rel=2e-3)
    assert float(cell.third[1]) == pytest.approx(-volume[2], rel=5e-3)
    assert float(cell.fourth[1]) == pytest.approx(-volume[3], rel=2e-2)


def test_what_columns_store_beyond_linear_answers():
    """Force and volume of a rod of one column, from one energy."""
    third, fourth = [4e3, 5e-5, -2e-10, -2e-16], [2e4, 2e-4, -2e-10, 3e-16, -1e-21]
    cell = eqx.tree_at(
        lambda c: (c.third, c.fourth), CELL, (jnp.array(third), jnp.array(fourth))
    )
    one = side_by_side(cell, jnp.zeros((1, 2)), 0.08)
    made = body(SE2(), R.constant("sigma_x"), one, 0.08, RUBBER, damping=0.0, single=False)
    e, p = 0.02, 40 * kPa
    push, volume = jax.jit(jax.grad(made.chambers.coenergy, argnums=(0, 1)))(
        jnp.array([e]), jnp.array([p])
    )
    a, b, c, d = third
    f, g, h, k, m = fourth
    force = 1.2e-4 * p - (a * e**2 + 2 * b * e * p + c * p**2) / 2
    force -= (f * e**3 + 3 * g * e**2 * p + 3 * h * e * p**2 + k * p**3) / 6
    room = 1e-4 + 1.2e-4 * e + 1e-9 * p - (b * e**2 + 2 * c * e * p + d * p**2) / 2
    room -= (g * e**3 + 3 * h * e**2 * p + 3 * k * e * p**2 + m * p**3) / 6
    assert float(push[0]) == pytest.approx(0.08 * force, rel=1e-9)
    assert float(volume[0]) == pytest.approx(0.08 * room, rel=1e-9)


def test_a_body_without_length_or_with_bad_damping_is_refused():
    with pytest.raises(ValueError, match=r"`length` must be positive, got -0\.01 m"):
        body(SE2(), R.constant("kappa_z"), column(CELL), -0.01, RUBBER, damping=0.0)
    with pytest.raises(ValueError, match="`damping`"):
        body(SE2(), R.constant("kappa_z"), column(CELL), 0.01, RUBBER, damping=np.nan)


@pytest.mark.parametrize("group", [SE2(), SE3()])
def test_a_column_bends_by_its_cell(group):
    """Constant strains: stiffness times strain is push times pressure."""
    names = ("kappa_z", "sigma_x")
    made = body(group, R.constant(*names), column(CELL), 0.08, RUBBER, damping=1e-3)
    q = jnp.linalg.solve(made.forces[0].stiffness, 40 * kPa * made.chambers.push[0])
    e, k = np.linalg.solve(CELL.stiffness[:2, :2], 40 * kPa * CELL.push[:2])
    assert np.allclose(q, [-k, e], rtol=1e-9)
    pressure = jnp.asarray(40 * kPa)
    got = made.chambers.coenergy(q, pressure) / pressure
    want = 0.08 * (CELL.gas + CELL.push[0] * e + CELL.push[1] * k + CELL.compliance * 20 * kPa)
    assert float(got) == pytest.approx(float(want), rel=1e-12)
    assert jnp.allclose(made.forces[1].matrix(jnp.zeros(())), 1e-3 * made.forces[0].stiffness)


def test_columns_side_by_side_have_the_stiffness_of_two_clamped_beams():
    length, half = 0.05, 13 * mm
    pair = side_by_side(CELL, jnp.array([[half, 0.0], [-half, 0.0]]), length)
    one = np.asarray(CELL.stiffness)
    assert pair.stiffness[0, 0] == pytest.approx(2 * one[0, 0])
    assert pair.stiffness[1, 1] == pytest.approx(2 * (one[1, 1] + one[0, 0] * half**2))
    assert pair.shear is not None and pair.shear[0] == pytest.approx(24 * one[1, 1] / length**2)
    # a force across the end: the ends stay parallel when a moment holds them so
    made = body(SE2(), R.constant("kappa_z", "sigma_y"), pair, length, RUBBER, damping=0.0)
    force = jnp.array([-1e-3 * length / 2, 0.0, 1e-3])
    q = jnp.linalg.solve(made.forces[0].stiffness, jnp.array([0.0, 1e-3 * length]))
    rest = R.equilibrium(made.rod, (*made.forces, R.TipWrench(force)))
    assert np.allclose(rest.q, q, rtol=1e-3, atol=1e-4)
    shift = float(R.tip_pose(made.rod, rest.q)[1, 2])
    assert shift == pytest.approx(1e-3 * length**3 / (24 * one[1, 1]), rel=2e-3)
    mass = float(pair.solid * RUBBER.density * length)
    assert float(jnp.sum(R.operators(made.rod).mass)) == pytest.approx(mass)


def test_fingers_stand_where_they_are_drawn(quick):
    hand = robots.Hand()
    made = robots.model(hand)
    assert made.ports == ("thumb", "index", "middle", "ring", "little")
    assert np.allclose(made.high, 60 * kPa) and np.allclose(made.low, -10 * kPa)
    feet, ends, tips = [], [], {}
    for name in made.ports:
        part = made.assembly[name]
        place = part.offset @ jnp.stack([part.body.length, *jnp.zeros(2), jnp.ones(())])
        along, up = part.offset[:3, 0], part.offset[:3, 1]
        finger = hand.thumb if name == "thumb" else hand.finger
        end = place[:3] + along * (finger.bellows.cap + finger.tip_radius)
        # the axis lies off the middle of the finger, towards its spine
        ends.append(end - up * CELL.center[0])
        feet.append(place[:3])
        tips[name] = place[0]
    skin = np.asarray(sdf.evaluate(hand.fingers(), jnp.stack(ends + feet)))
    assert np.max(np.abs(skin[:5])) < 1e-6 and np.max(skin[5:]) < 0
    x = [float(tips[name]) for name in made.ports]
    assert x == sorted(x, reverse=True)


def test_the_gripper_hangs_on_the_arm(quick):
    robot = robots.Manipulator()
    made = robots.model(robot)
    assert made.counts == (3, None) and np.allclose(made.high, np.array([30, 30, 30, 60]) * kPa)
    arm = made.assembly["arm"]
    end = arm.offset[:3, 3] + arm.body.length * arm.offset[:3, 0]
    assert np.allclose(end, [0, 0, 75 * mm])
    away = robot.finger_distance + CELL.center[0]
    for k in range(3):
        foot = end + arm.offset[:3, :3] @ made.assembly[f"finger_{k}"].offset[:3, 3]
        height = robot.finger_foot + robot.finger.bellows.cap
        assert float(foot[2]) == pytest.approx(float(height))
        assert float(jnp.hypot(foot[0], foot[1])) == pytest.approx(float(away))
    inputs = made.inputs(jnp.arange(4.0))
    assert inputs["arm_valve.setpoint"].tolist() == [0, 1, 2]
    assert float(inputs["gripper_valve.setpoint"]) == 3
    fed = dict(made.network.wires)
    assert fed["body.finger_2_pressure"] == "gripper_air.pressure"
    assert fed["gripper_air.volume"] == "gripper_volume.value"


def test_what_has_no_model_is_told(quick):
    with pytest.raises(TypeError, match="need a BendingActuator"):
        robots.model(robots.Bellows())
    with pytest.raises(ValueError, match="need one of bending"):
        robots.bench("foot")
    with pytest.raises(ValueError, match="no period"):
        robots.model(robots.BendingActuator(num_bellows=1))


def test_a_printed_actuator_behind_a_board():
    """From the drawing to set-points and pressures, with converters, noise and dead time."""
    valves, limits = simulated("bending", seed=3)
    with pytest.raises(ValueError, match="made for 0.005"):
        valves._advance(valves.state, np.zeros(1), 1e-3)
    clock = SimulatedClock()
    board = LocalBoard(limits, valves, clock)
    board.arm()
    ticks = list(
        run_loop(
            board,
            clock,
            lambda t, p, s: (40 * kPa, s),
            None,
            duration=0.6,
            period=0.01,
            limits=board.board.settings.limits[0][:2],
        )
    )
    assert limits.limits[0][:2] == (-10 * kPa, 100 * kPa)
    pressure = np.array([tick.pressure[0] for tick in ticks])
    assert np.allclose(pressure[-10:], 40 * kPa, atol=5 * 80) and pressure[2] < 20 * kPa
    assert np.allclose(pressure / STEP, np.rint(pressure / STEP), atol=1e-6)
    assert np.std(pressure[-10:]) > 20
    q = valves.state.state["body"]["q"]
    assert -10 < float(q[0]) < -3 and 0.02 < float(q[3]) < 0.06  # bends down, grows
    clock.sleep_until(clock.now() + 0.8)
    assert abs(board.read_pressure()[0]) < 500
