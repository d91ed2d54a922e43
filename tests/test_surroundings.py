"""What examples are put together from: robots among other bodies, simulated boards, streams."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import design, fem, mesh, robots, rod, systems, vision
from sorojax.design.pneunet import body, body_of
from sorojax.math.status import Status
from sorojax.robots.models.supply import Model
from sorojax.robots.surroundings import InContact
from sorojax.rod.dynamics.rollout import Trajectory
from sorojax.units import kPa, mm
from sorojax_hardware import SimulatedClock, run_loop, simulated_board
from sorojax_hardware.protocols import Image

LAW = sj.contact.LinePenalty(stiffness=1e8, smoothing=5e-6)
BEAM = rod.rod(
    sj.SE2(),
    rod.chebyshev(kappa_z=2),
    rod.circle(5 * mm),
    length=80 * mm,
    young_modulus=0.6e6,
    poisson_ratio=0.45,
    density=1080.0,
    nodes=4,
)


def test_poses_of_what_hangs():
    assert np.allclose(robots.pose_below(0.2) @ jnp.array([0, 0, 0, 1.0]), [0, 0, -0.2, 1])
    turned = robots.upside_down(0.3) @ jnp.array([0.1, 0.2, 0.05, 1.0])
    assert np.allclose(turned, [0.1, -0.2, 0.25, 1])


def test_a_robot_hangs_over_a_cylinder():
    link = robots.cylinder(0.1, 10 * mm, 20 * mm)
    own = rod.assembly(sj.SE3(), arm=rod.Part(link), hand=rod.Part(link, on="arm"))
    network = systems.Network({"body": systems.AssemblyBody(own)}, {}, ())
    model = Model(network, (), (), [], [])
    thing, floor = robots.standing_cylinder(0.05, 20 * mm, 40 * mm, LAW)
    made = robots.with_contacts(
        model, (rod.PartForce("thing", floor),), mount=robots.upside_down(0.3), thing=thing
    )
    whole = made.assembly
    q = rod.rest(whole)
    poses = rod.tip_pose(whole, q)
    assert whole.names == ("arm", "hand", "thing")
    for name, z in (("arm", -1), ("hand", -1), ("thing", 1)):
        assert np.allclose(poses[name][:3, 2], [0, 0, z])
    middle = robots.middle(whole, q, ["arm", "hand"])
    assert np.allclose(middle, [0, 0, 0.3]) and np.isclose(poses["thing"][2, 3], 20 * mm)
    seen = systems.contact_history(
        whole, (rod.PartForce("thing", floor),), q[None], jnp.zeros((1, 6))
    )
    assert abs(seen.overlap[0, 0]) < 1e-12  # it stands
    network = SimpleNamespace(state={"body": {"q": q, "v": jnp.zeros(6)}})
    states = [InContact(network)] * 3  # type: ignore[arg-type]
    film, few = robots.replay(whole, states), robots.replay(whole, states, ["thing"])
    assert set(film.poses) == {"arm", "hand", "thing"} and set(few.poses) == {"thing"}
    assert np.array_equal(few.q, jnp.stack([q] * 3)) and few.v.shape == (3, 6)
    assert np.allclose(few.poses["thing"], poses["thing"][None])
    assert np.allclose(film.poses["hand"], poses["hand"][None])
    with pytest.raises(ValueError, match="there is no part `leg`"):
        robots.replay(whole, states, ["leg"])
    with pytest.raises(ValueError, match="has a part called `arm` already"):
        robots.with_contacts(model, (), arm=thing)


def test_a_rod_behind_a_simulated_board_keeps_its_states():
    def loads(pressure):
        chamber = rod.Actuation(lambda q: jnp.full((2, 1), 1e-6), pressure)
        return rod.Damping(0.02), chamber

    board, valves = simulated_board(
        *robots.rod_stepper(BEAM, loads, lag=0.03),
        (-20 * kPa, 60 * kPa),
        keep=True,
        noise=0.0,
        resolution=0.0,
    )
    assert isinstance(board.clock, SimulatedClock) and board.num_ports == 1
    board.write_pressure(np.array([10 * kPa]))
    ticks = run_loop(
        board,
        board.clock,
        lambda t, p, _: (10 * kPa, None),
        None,
        duration=0.1,
        period=0.01,
        limits=(-20 * kPa, 60 * kPa),
    )
    assert len(list(ticks)) == 10
    states = valves.states or []
    pressures = np.array([float(state.pressure[0]) for state in states])
    assert len(pressures) > 15 and pressures[0] == 0 and states[-1] is valves.state
    # an exponential towards the set-point, from the step at which it moves on
    left = 10 * kPa - pressures[np.argmax(pressures > 0) :]
    assert np.allclose(left[1:] / left[:-1], np.exp(-0.005 / 0.03), rtol=1e-9)
    assert float(valves.state.q[0]) > 0


def test_a_stream_of_markers_tells_places_and_when_there_is_no_image():
    centres = np.array([[120.0, 100.0], [220.0, 140.0]])
    kinds, radii = np.array([0, 1]), np.full(2, 10.0)

    class Two:
        """Nothing, and then discs that have moved."""

        def __init__(self):
            self.waiting = [None, centres + [3.0, -2.0]]

        def read(self):
            where = self.waiting.pop(0)
            if where is None:
                return None
            canvas = vision.draw_discs(vision.background(320, 240), where, radii, kinds)
            return Image(0.0, canvas)

    first = vision.Discs(centres, radii, kinds)
    colours = (vision.RED, vision.GREEN)
    stream = vision.MarkerStream(Two(), first, colours, lambda pixels: pixels / 1000)
    assert np.all(np.isnan(stream.read())) and stream.images == 0
    assert np.allclose(stream.read(), (centres + [3.0, -2.0]) / 1000, atol=3e-4)
    assert stream.images == 1


def test_a_pid_of_two_signals_is_two_of_one():
    low, high = np.array([-1.0, -0.2]), np.array([1.0, 0.3])
    gains: dict[str, Any] = {"integral_gain": 3.0, "derivative": 0.05, "feed_forward": 0.5}

    def run(target, low, high, seen):
        pid = systems.PID(2.0, reference=systems.Constant(target), low=low, high=high, **gains)
        memory, told = pid.start(0.0, seen[0]), []
        for k, value in enumerate(seen):
            command, memory = pid(0.1 * k, value, memory)
            told.append(command)
        return np.stack(told)

    target, seen = np.array([1.0, -0.5]), np.array([[0.0, 0.1], [0.4, 0.0], [0.9, -0.3]])
    both = run(target, low, high, jnp.asarray(seen))
    for k in range(2):
        alone = run(target[k], low[k], high[k], jnp.asarray(seen[:, k]))
        assert np.allclose(both[:, k], alone, rtol=1e-12)
    with pytest.raises(ValueError, match="`low` must be below `high`"):
        systems.PID(1.0, low=[0.0, 1.0], high=[1.0, 0.5])


def test_what_an_impedance_asked_for_along_a_motion():
    goal = systems.Waypoints([0.0, 1.0], [[80 * mm, 0.0], [70 * mm, 10 * mm]])
    law = systems.CartesianImpedance(BEAM, (rod.Damping(0.02),), goal, 10.0, 0.5)
    time, q = jnp.array([0.0, 0.5]), jnp.array([[0.0, 0.0], [3.0, 1.0]])
    path = Trajectory(time, q, 0.1 * q, Status.successful)
    done = systems.tracking(law, path)
    assert np.allclose(done.goal[1], [75 * mm, 5 * mm])
    assert np.allclose(done.tip[0], [80 * mm, 0.0])
    assert np.allclose(done.effort[1], law.effort(time[1], q[1], 0.1 * q[1]), rtol=1e-9)


def test_forces_on_the_backs_of_bellows():
    actuator = robots.BellowsActuator(num_bellows=2)
    cells = mesh.triangulate(actuator.body(), size=1.5 * mm, order=2)
    rubber = sj.material.presets.dragon_skin_30()
    made = robots.bellows_problem(actuator, cells, rubber, gravity=[9.81, 0.0], pushed=(1,))
    assert [load.name for load in made.loads] == ["air", "gravity", "push_1"]
    push = made.loads[2]
    assert isinstance(push, fem.Force)
    backs = np.asarray(cells.points)[np.asarray(push.nodes)]
    assert np.allclose(backs[:, 1], actuator.height) and backs[:, 0].min() > 16 * mm
    plain = robots.bellows_problem(actuator, cells, rubber)
    assert len(plain.loads) == 1 and isinstance(plain.loads[0], fem.Pressure)
    with pytest.raises(ValueError, match="got bellow 2, need 0 to 1"):
        robots.bellows_problem(actuator, cells, rubber, pushed=(2,))


@pytest.mark.parametrize("chamber", ["darcy", "flood"])
def test_a_cell_from_variables_is_that_from_their_densities(chamber):
    cell = design.pneunet_cell(
        divisions=(5, 10), radius=4 * mm, wall=3 * mm, base=3 * mm, chamber=chamber
    )
    sharpness = jnp.asarray(4.0)
    one = body_of(cell, cell.start, sharpness)
    other = body(cell, cell.plan(cell.start, sharpness))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.allclose(a, b, rtol=1e-12)
