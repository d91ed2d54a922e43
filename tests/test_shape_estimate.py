"""Shapes from markers: against the shapes that made them, with contact, noise and gaps."""

import queue
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.lie import SE2, SE3
from sorojax.math.status import Status
from sorojax.systems import (
    Markers,
    ShapeFilter,
    estimate_shape,
    start_filter,
    update_filter,
)
from sorojax_hardware import Image, Latest, MemoryBoard, SimulatedClock, run_loop

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=1100.0)
PLANAR = R.rod(SE2(), R.chebyshev(kappa_z=3), R.circle(6e-3), nodes=8, **FINGER)
SPATIAL = R.rod(SE3(), R.chebyshev(kappa_y=2, kappa_z=2), R.circle(6e-3), nodes=6, **FINGER)
# what is measured has modes that the estimator does not know
TRUE = R.rod(SE2(), R.chebyshev(kappa_z=6), R.circle(6e-3), nodes=10, **FINGER)
S = jnp.array([0.25, 0.5, 0.75, 1.0])


def pushed(force, at=0.55):
    """The true finger held by an unknown contact on its side."""
    push = R.PointWrench([0.0, 0.0, force], s=at)
    return R.equilibrium(TRUE, (push,)).q


def seen(q, s=S, model=TRUE):
    return R.forward_kinematics(model, q, s)[:, :2, 2]


@pytest.mark.parametrize("group", ["planar", "spatial"])
def test_exact_markers_give_back_the_shape(group):
    model = PLANAR if group == "planar" else SPATIAL
    dim = model.group.space_dim
    q = jnp.array([12.0, -6.0, 3.0]) if group == "planar" else jnp.array([9.0, -4.0, 6.0, 3.0])
    poses = R.forward_kinematics(model, q, S)
    offset = jnp.array([[0.0, 4e-3, 1e-3][:dim]] * 4)
    for arm in (None, offset):
        places = poses[:, :dim, dim]
        if arm is not None:
            places = places + jnp.einsum("mij,mj->mi", poses[:, :dim, :dim], arm)
        markers = Markers(model, S, arm)
        shape = estimate_shape(markers, places, jnp.zeros_like(q), trust=1e-7, iterations=8)
        assert jnp.max(jnp.abs(shape.q - q)) < 1e-5 and shape.error < 1e-8
        assert shape.status == Status.successful and shape.seen == 4


def test_unknown_contact_and_noise_leave_the_tip_within_a_millimetre():
    random, off = np.random.default_rng(0), []
    q = jnp.zeros(3)
    for force in np.linspace(-0.15, 0.15, 31):
        true = pushed(float(force))
        places = seen(true) + 2e-4 * random.standard_normal((4, 2))
        q = estimate_shape(Markers(PLANAR, S), places, q).q
        off.append(jnp.linalg.norm(R.tip_pose(PLANAR, q)[:2, 2] - seen(true)[-1]))
    assert jnp.max(jnp.array(off)) < 1e-3


def test_what_no_marker_shows_is_filled_by_the_equilibrium():
    """One marker at the tip, the weight known: the middle is where it should be."""
    weight = R.Gravity([0.0, -9.81])
    true = R.equilibrium(PLANAR, (weight, R.TipWrench([0.0, 0.0, 0.02]))).q
    tip = seen(true, S[3:], PLANAR)
    q = jnp.zeros(3)
    for _ in range(4):
        shape = estimate_shape(Markers(PLANAR, S[3:]), tip, q, forces=(weight,), iterations=8)
        q = shape.q
    middle = (
        R.forward_kinematics(PLANAR, q, S)[1, :2, 2]
        - R.forward_kinematics(PLANAR, true, S)[1, :2, 2]
    )
    assert shape.error < 1e-4 and jnp.linalg.norm(middle) < 5e-4
    nothing = jnp.full((1, 2), jnp.nan)
    alone = estimate_shape(Markers(PLANAR, S[3:]), nothing, q, forces=(weight,), iterations=8)
    rest = R.equilibrium(PLANAR, (weight,)).q
    assert alone.seen == 0 and jnp.max(jnp.abs(alone.q - rest)) < 1e-3 * jnp.max(jnp.abs(rest))


@pytest.mark.stress(54)
def test_a_hidden_marker_counts_for_nothing():
    true = pushed(0.1)
    places = seen(true)
    hidden = places.at[1].set(jnp.nan)
    few = Markers(PLANAR, S[jnp.array([0, 2, 3])])
    q = jnp.zeros(3)
    a = estimate_shape(Markers(PLANAR, S), hidden, q, iterations=8)
    b = estimate_shape(few, places[jnp.array([0, 2, 3])], q, iterations=8)
    assert jnp.allclose(a.q, b.q, rtol=1e-9) and a.seen == 3


PERIOD = 1 / 60
LOADS = (R.Damping(0.01), R.Gravity([0.0, -9.81]))


@pytest.fixture(scope="module")
def swing():
    """The true finger let go from a bend, at the times of the frames."""
    q = R.equilibrium(TRUE, (R.TipWrench([0.0, 0.0, 0.1]),)).q
    return R.rollout(TRUE, q, jnp.zeros(6), LOADS, step=PERIOD / 16, saves=60, every=16)


def follow(swing, hidden=(), noise=3e-4):
    random, estimator = np.random.default_rng(1), ShapeFilter(Markers(PLANAR, S), PERIOD)
    now, track = start_filter(estimator), []
    for k in range(61):
        places = seen(swing.q[k]) + noise * random.standard_normal((4, 2))
        if k in hidden:
            places = jnp.full((4, 2), jnp.nan)
        now = update_filter(estimator, now, places, forces=LOADS)
        track.append(now)
    return track


def tips(track):
    return jnp.array([R.tip_pose(PLANAR, one.q)[:2, 2] for one in track])


def test_the_filter_beats_its_markers(swing):
    true = jnp.array([seen(q)[-1] for q in swing.q])
    off = jnp.linalg.norm(tips(follow(swing)) - true, axis=1)[10:]
    assert jnp.sqrt(jnp.mean(off**2)) < 3e-4 and jnp.max(off) < 1e-3


def test_the_filter_knows_how_sure_it_is(swing):
    track = follow(swing, hidden=range(30, 36))
    missed = [int(one.missed) for one in track[28:38]]
    assert missed == [0, 0, 1, 2, 3, 4, 5, 6, 0, 0]
    assert [bool(one.stale) for one in track[28:38]] == [m >= 3 for m in missed]
    spread = [float(jnp.trace(one.covariance[:3, :3])) for one in track]
    assert all(a < b for a, b in zip(spread[29:34], spread[30:35], strict=True))
    assert spread[37] < spread[34]
    for one in track:
        assert jnp.allclose(one.covariance, one.covariance.T)
        assert jnp.linalg.eigvalsh(one.covariance)[0] > -1e-12 * spread[0]
    true = jnp.array([seen(q)[-1] for q in swing.q])
    gone = jnp.linalg.norm(tips(track)[30:36] - true[30:36], axis=1)
    assert jnp.max(gone) < 5e-3  # six frames on the model alone
    assert not track[-1].stale


class Stopping:
    """A camera whose `read` waits for the picture that it is given."""

    def __init__(self):
        self.given = queue.Queue()

    def read(self):
        return self.given.get()

    def close(self):
        pass


def seen_by(camera, latest, k, places):
    """Hand the camera a picture and wait until the reading thread has it."""
    camera.given.put(Image(k * PERIOD, np.asarray(places)))
    start = time.monotonic()
    while latest._image is None and latest._last < k * PERIOD:
        assert time.monotonic() - start < 5
        time.sleep(1e-4)


def test_a_camera_that_is_gone_for_two_seconds_does_not_hold_up_the_loop(swing):
    """120 frames missed, then one that comes twice, one of the past, and one without any
    marker: the loop keeps its ticks, the filter says how old it is and finds back."""
    camera, clock = Stopping(), SimulatedClock()
    latest, estimator = Latest(camera), ShapeFilter(Markers(PLANAR, S), PERIOD)
    gone, nothing = range(20, 140), np.full((4, 2), np.nan)
    track = [start_filter(estimator)]

    def measure(t, pressure):
        image = latest.read()
        places = nothing if image is None else image.colour
        track.append(update_filter(estimator, track[-1], places, forces=LOADS))
        return pressure

    ticks = run_loop(
        MemoryBoard(clock, 1),
        clock,
        lambda t, p, s: (0.0, s),
        None,
        duration=160 * PERIOD,
        period=PERIOD,
        limits=(0, 1),
        measure=measure,
    )
    seen_by(camera, latest, 1, seen(swing.q[60]))
    for k, tick in enumerate(ticks, start=1):
        assert tick.late < 1e-9
        if k + 1 in gone:
            continue
        if k + 1 in (141, 142):  # the same time again, and an earlier one: nothing is taken
            camera.given.put(Image((140 - (k - 140)) * PERIOD, 9.0 + np.zeros((4, 2))))
            continue
        seen_by(camera, latest, k + 1, nothing if k + 1 == 144 else seen(swing.q[60]))
    camera.given.put(Image(-1.0, nothing))  # lets the reading thread end
    latest.close()
    assert len(track) == 161 and latest.dropped == 3
    assert [int(one.missed) for one in track[19:24]] == [0, 1, 2, 3, 4]
    assert [bool(one.stale) for one in track[19:24]] == [False, False, False, True, True]
    assert int(track[139].missed) == 120 and int(track[140].missed) == 0
    assert [int(one.missed) for one in track[141:146]] == [1, 2, 0, 1, 0]
    spread = [float(jnp.trace(one.covariance[:3, :3])) for one in track]
    assert spread[139] > 2 * spread[19] and spread[160] < 1.5 * spread[19]
    assert all(jnp.all(jnp.isfinite(one.q)) for one in track)


@pytest.mark.stress(54)
def test_numbers_that_break_keep_the_last_estimate(swing):
    estimator = ShapeFilter(Markers(PLANAR, S), PERIOD)
    good = update_filter(estimator, start_filter(estimator), seen(swing.q[0]), forces=LOADS)
    bad = update_filter(estimator, good, seen(swing.q[1]), forces=(R.Gravity([jnp.nan, 0.0]),))
    assert bad.status == Status.not_finite and jnp.array_equal(bad.q, good.q)
    assert bad.missed == good.missed + 1


def test_estimates_are_differentiable():
    true = pushed(0.1)

    def tip(places):
        return estimate_shape(Markers(PLANAR, S), places, jnp.zeros(3), iterations=8).q[0]

    places, way = seen(true), jnp.ones((4, 2)).at[0].set(-0.5)
    slope = jnp.vdot(jax.grad(tip)(places), way)
    step = 1e-6 * way
    difference = (tip(places + step) - tip(places - step)) / 2e-6
    assert float(slope) == pytest.approx(float(difference), 1e-5)


def test_a_filter_can_be_tuned_by_its_gradient(swing):
    def off(scale):
        estimator = ShapeFilter(Markers(PLANAR, S), PERIOD, marker_noise=3e-4 * scale)
        now = update_filter(estimator, start_filter(estimator), seen(swing.q[2]), forces=LOADS)
        return jnp.vdot(now.q, now.q) + 1e-3 * jnp.vdot(now.v, now.v)

    off, one = jax.jit(off), jnp.ones(())
    slope = jax.jit(jax.grad(off))(one)
    difference = (off(one + 1e-4) - off(one - 1e-4)) / 2e-4
    assert float(slope) == pytest.approx(float(difference), 1e-6)


def test_wrong_markers_are_refused():
    with pytest.raises(ValueError, match="Markers: `s`"):
        Markers(PLANAR, [0.5, 1.2])
    with pytest.raises(ValueError, match="offset"):
        Markers(PLANAR, S, jnp.zeros((2, 2)))
    with pytest.raises(ValueError, match="ShapeFilter: `period`"):
        ShapeFilter(Markers(PLANAR, S), 0.0)
