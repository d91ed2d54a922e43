"""What robots are put together from, the PneuNet, and what contacts did along a motion."""

import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import mesh as M, robots, rod as R, sdf, systems
from sorojax.contact import LinePenalty

ROD = {"length": 0.1, "young_modulus": 1e5, "poisson_ratio": 0.4, "density": 1e3, "nodes": 4}


def test_a_ring_hangs_and_closes_inwards():
    finger = R.rod(sj.SE3(), R.chebyshev(kappa_z=1), R.circle(0.005), **ROD)
    parts = robots.ring(finger, 3, 0.04, "leg")
    assert list(parts) == ["leg_0", "leg_1", "leg_2"]
    frames = np.stack([part.offset for part in parts.values()])
    assert np.allclose(np.linalg.det(frames[:, :3, :3]), 1, rtol=0, atol=1e-14)
    place = frames[:, :3, 3]
    assert np.allclose(place[0], [0.04, 0, 0]) and np.allclose(place.sum(axis=0), 0, atol=1e-15)
    assert np.allclose(frames[:, :3, 0], [0, 0, -1])
    assert np.allclose(frames[:, :3, 1], -place / 0.04)
    hand = R.assembly(sj.SE3(), **parts)
    poses = R.forward_kinematics(hand, jnp.full(3, 8.0), [1.0])
    for name in parts:
        tip = np.asarray(poses[name])[0, :3, 3]
        assert np.linalg.norm(tip[:2]) < 0.035 and tip[2] < 0
    for wrong in ((0, 0.04), (3, 0.0)):
        with pytest.raises(ValueError, match="ring: "):
            robots.ring(finger, *wrong)


def test_a_ball_stands_on_points_that_are_spread_over_it():
    law = LinePenalty(1e6, 1e-5)
    part, floor = robots.standing_ball(0.2, 0.03, law, at=[0.1, 0.2, 0.3])
    assert np.allclose(part.offset[:3, 3], [0.1, 0.2, 0.33]) and float(part.body.mass) == 0.2
    assert np.allclose(part.body.inertia, 0.4 * 0.2 * 0.03**2)
    points = np.asarray(floor.points)
    assert np.allclose(np.linalg.norm(points, axis=1), 0.03)
    assert np.abs(points.mean(axis=0)).max() < 0.02 * 0.03  # as many on all sides
    spread = points.T @ points / len(points)
    assert np.allclose(spread, 0.03**2 / 3 * np.eye(3), atol=0.02 * 0.03**2)
    share = np.sum(np.asarray(floor.lengths) ** 2)
    assert share == pytest.approx(4 * np.pi * 0.03**2)  # what the points stand for
    assert float(floor.obstacle(jnp.array([0.0, 0.0, 0.35]))) == pytest.approx(0.05)
    with pytest.raises(ValueError, match="standing_ball: `at`"):
        robots.standing_ball(0.2, 0.03, law, at=[0.1, 0.2])


def test_a_cylinder_has_its_inertia_and_its_rim():
    link = robots.cylinder(0.3, 0.02, 0.05)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (400_000, 3)) * [0.02, 0.02, 0.025]
    inside = points[np.hypot(points[:, 0], points[:, 1]) < 0.02]
    square = (inside**2).mean(axis=0)
    expected = 0.3 * (square.sum() - square)
    assert np.allclose(link.inertia, expected, rtol=0.01) and float(link.mass) == 0.3
    points, lengths = robots.rim(0.02, -0.025, 12)
    assert np.allclose(np.hypot(*points[:, :2].T), 0.02) and np.allclose(points[:, 2], -0.025)
    assert lengths.sum() == pytest.approx(2 * np.pi * 0.02)
    with pytest.raises(ValueError, match="three or more"):
        robots.rim(0.02, 0.0, 2)


def test_what_contacts_did_is_what_they_give():
    law = LinePenalty(stiffness=1e5, smoothing=1e-5, friction=0.5, slip=1e-3)
    finger = R.rod(sj.SE2(), R.chebyshev(kappa_z=2), R.circle(0.005), **ROD)
    link = R.Part(R.Link(0.01, 1e-6), R.Free(), offset=jnp.eye(3).at[:2, 2].set([0.05, 0.012]))
    model = R.assembly(sj.SE2(), arm=R.Part(finger), ball=link)
    ground = R.ObstacleContact(sdf.HalfPlane([0.0, -0.0045], [0.0, 1.0]), 0.005, law, points=9)
    grip = R.LinkContact(sdf.Circle([0.0, 0.0], 0.0075), 0.005, law, points=9)
    contacts = R.PartForce("arm", ground), R.PairForce("arm", "ball", grip)
    q = jnp.stack([R.rest(model), R.rest(model).at[0].set(2.0)])
    v = jnp.zeros((2, R.num_dof(model))).at[:, -2].set(0.01)
    seen = systems.contact_history(model, contacts, q, v)
    assert np.isclose(seen.overlap[0, 0], 0.005 - 0.0045, rtol=1e-9)
    assert np.isclose(seen.overlap[0, 1], 0.0125 - 0.012, rtol=1e-9)
    for k in range(2):
        here, now = R.motion(model, q[k], v[k]), jnp.zeros(())
        both = R.total_force(contacts, now, here) - R.total_force((), now, here)
        assert np.allclose(seen.effort[k].sum(axis=0), both, rtol=0, atol=1e-10)
    up, down = np.asarray(seen.push[0, :, 1])
    assert up > 0 > down  # the ground lifts the arm, the ball presses on it
    assert np.isclose(seen.effort[0, 1, -1], -down, rtol=1e-6)  # and is pressed as hard
    assert seen.effort[0, 1, -2] < 0 == seen.effort[0, 0, -2]  # friction brakes the ball
    at = {"arm": [0, 1], "ball": [2, 3, 4]}
    for parts in (["ball"], ["arm"], ["ball", "arm"]):
        some = systems.contact_history(model, contacts, q, v, parts)
        chosen = [k for name in parts for k in at[name]]
        assert np.allclose(some.effort, seen.effort[..., chosen], rtol=0, atol=1e-12)
        assert np.array_equal(some.overlap, seen.overlap)
    with pytest.raises(ValueError, match="there is no part `leg`"):
        systems.contact_history(model, contacts, q, v, ["leg"])
    with pytest.raises(ValueError, match=r"got the parts \['arm'\] of a rod"):
        systems.contact_history(finger, (ground,), q[:, :2], v[:, :2], ["arm"])
    with pytest.raises(TypeError, match="got a Gravity, need contacts"):
        systems.contact_history(model, (R.Gravity(),), q, v)


def test_a_pneunet_is_meshed_between_its_lines():
    robot = robots.PneuNet(num_chambers=3)
    cells = robots.pneunet_mesh(robot)
    box, foot = float(robot.length - robot.strip) * 20e-3, 5.7e-3 * 3.54e-3
    air = 3 * 1.84e-3 * (17.49 - 3.54) * 1e-3
    slots = 2 * 0.55e-3 * (20 - 10.9) * 1e-3
    area = float(M.cell_areas(cells).sum())
    assert area == pytest.approx(box + foot - air - slots, rel=1e-9)
    layer = float(M.cell_areas(cells)[cells.regions["layer"]].sum())
    assert layer == pytest.approx(1.75e-3 * float(robot.length), rel=1e-9)
    middle = np.array([[float(x), 10e-3] for x in robot.middles])
    assert np.all(np.asarray(robot.chambers()(jnp.asarray(middle))) < 0)
    assert np.all(np.asarray(robot.body()(jnp.asarray(middle))) > 0)
    walls = M.facets_on(cells, robot.chambers())
    assert len(walls) > 20 and len(M.facets_on(cells, robot.slots())) > 8
    rubber = sj.material.presets.dragon_skin_30()
    made = robots.bellows_problem(robot, cells, rubber, depth=0.02)
    assert [load.name for load in made.loads] == ["air"]
    inside = made.loads[0]
    assert isinstance(inside, sj.fem.Pressure) and inside.facets.shape == walls.shape
    with pytest.raises(ValueError, match="with a PneuNet, which has no bellows"):
        robots.bellows_problem(robot, cells, rubber, pushed=[0])
    with pytest.raises(ValueError, match="rising levels"):
        robots.PneuNet(roof=0.021)
    with pytest.raises(ValueError, match="walls above zero"):
        robots.PneuNet(slot_width=0.0057)


def test_the_backs_of_bellows_lie_on_the_body():
    robot = robots.BellowsActuator(num_bellows=3)
    ends = np.stack([robot.back(k) for k in range(3)])
    middles = jnp.asarray(ends.mean(axis=1))
    assert np.allclose(robot.body()(middles), 0, atol=1e-12)
    assert np.allclose(np.diff(ends[:, 0, 0]), float(robot.pitch))
    with pytest.raises(ValueError, match="need one or more"):
        robots.BellowsActuator(num_bellows=0)
    with pytest.raises(ValueError, match="need 0 to 2"):
        robot.back(3)
