"""Stress cases of rotations and rods."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.lie import SE2, SE3, change_of_logarithm, logarithm
from sorojax.math.ode.steppers import RungeKutta4
from sorojax.math.status import Status

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DISC = R.circle(6e-3, shear_factor=27 / 28)
EI = 1e6 * float(DISC.second_moment_z)


def planar(basis, **options):
    return R.rod(SE2(), basis, DISC, **{**FINGER, **options})


@pytest.mark.stress(1)
@pytest.mark.parametrize("group", [SE2(), SE3()])
def test_the_exponential_at_next_to_nothing(group):
    n, rot = group.algebra_dim, group.rotation_dim
    turn = jax.jit(jax.jacfwd(group.exp))
    for angle in (0.0, 1e-12, 1e-8, 1e-6):
        twist = jnp.zeros(n).at[rot - 1].set(angle).at[rot].set(1.0)
        pose = np.asarray(group.exp(twist))
        d = pose.shape[0] - 1
        exact = np.eye(d + 1)
        exact[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        exact[0, d] = 1 - angle**2 / 6
        exact[1, d] = angle / 2
        assert np.abs(pose - exact).max() <= 2.3e-16
        assert jnp.all(jnp.isfinite(turn(twist)))


@pytest.mark.stress(2)
def test_the_logarithm_of_next_to_nothing():
    for angle in (1e-12, 1e-8, 1e-6):
        twist = angle * jnp.array([0.6, 0.0, 0.8, 0.0, 0.0, 0.0])
        back = logarithm(SE3(), SE3().exp(twist))
        assert jnp.abs(back - twist).max() <= 4 * np.finfo(float).eps * angle


@pytest.mark.stress(3)
def test_the_logarithm_next_to_half_a_turn():
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(20, 3))
    axes = np.concatenate([np.eye(3), drawn / np.linalg.norm(drawn, axis=1, keepdims=True)])

    @jax.jit
    def both(w):
        pose = SE3().exp(w)
        apart = jax.jacfwd(lambda d: logarithm(SE3(), SE3().exp(d) @ pose))(jnp.zeros(6))
        return SE3().exp(logarithm(SE3(), pose)) - pose, apart - change_of_logarithm(SE3(), w)

    for gap in (1e-3, 1e-6, 1e-8, 1e-10, 0.0):
        for axis in axes:
            apart, slope = both(
                jnp.concatenate([jnp.array((np.pi - gap) * axis), jnp.zeros(3)])
            )
            assert jnp.abs(apart).max() <= 2e-15
            # At half a turn the answer may be the other of the two.
            assert gap <= 1e-10 or jnp.abs(slope).max() <= 1e-6


@pytest.mark.stress(4)
@pytest.mark.parametrize("angle", [1e-4, 1e-3, 3e-2])
def test_short_arcs_in_single_precision(angle):
    twist = np.array([0.0, 0.0, angle, 1.0, 0.0, 0.0], np.float32)
    sideways = SE3().exp(jnp.asarray(twist))[1, 3] / np.float32(angle)
    assert abs(float(sideways) - (1 - np.cos(angle)) / angle**2) < 4 * np.finfo(np.float32).eps


@pytest.mark.stress(5)
def test_a_straight_rod_has_all_derivatives():
    rod = R.rod(SE3(), R.chebyshev(kappa_y=2, kappa_z=2, sigma_x=1), DISC, **FINGER)

    def tip(q):
        return R.tip_pose(rod, q)

    zero = jnp.zeros(5)
    pose, slope, bend = jax.jit(lambda q: (tip(q), jax.jacfwd(tip)(q), jax.hessian(tip)(q)))(
        zero
    )
    assert jnp.abs(pose - jnp.eye(4).at[0, 3].set(0.08)).max() < 1e-15
    assert jnp.all(jnp.isfinite(slope)) and jnp.all(jnp.isfinite(bend))


@pytest.mark.stress(6)
@pytest.mark.parametrize("spans, turns", [(1, 1), (4, 1), (16, 1), (64, 1), (16, 10)])
def test_a_moment_closes_the_circle(spans, turns):
    basis = R.piecewise_constant(kappa_z=spans) if spans > 1 else R.constant("kappa_z")
    # A rod of 6 mm would be inside out in a ring of 1.3 mm.
    thin = 0.1 if turns > 1 else 1.0
    section, nodes = R.circle(thin * 6e-3), max(24, 2 * spans, 16 * turns)
    rod = R.rod(SE2(), basis, section, **{**FINGER, "nodes": nodes})
    moment = 2 * np.pi * turns * thin**4 * EI / 0.08
    rest = R.equilibrium(rod, (R.TipWrench([moment, 0.0, 0.0]),))
    assert rest.status == Status.successful
    assert jnp.abs(R.tip_pose(rod, rest.q)[:2, 2]).max() < 1e-8 * 0.08


@pytest.mark.stress(7)
def test_a_column_below_at_and_above_its_critical_load():
    rod = planar(R.chebyshev(kappa_z=4), nodes=10)
    critical = np.pi**2 * EI / (4 * 0.08**2)

    @eqx.filter_jit
    def pushed(share, side, q):
        wrench = critical * jnp.stack([jnp.zeros_like(share), -share, side])
        return R.equilibrium(rod, (R.TipWrench(wrench),), q)

    straight, bowed, none = jnp.zeros(4), jnp.array([10.0, 0.0, 0.0, 0.0]), jnp.array(0.0)
    below = pushed(jnp.array(0.9), none, bowed)
    assert below.status == Status.successful and jnp.abs(below.q).max() < 1e-6
    assert below.negative_eigenvalues == 0
    # Straight is in balance still, and the answer says that it is not stable.
    above = pushed(jnp.array(1.1), none, straight)
    assert above.status == Status.unstable_equilibrium and above.negative_eigenvalues == 1
    for side in (none, jnp.array(1e-6)):
        bent = pushed(jnp.array(1.1), side, bowed)
        assert bent.status == Status.successful and bent.negative_eigenvalues == 0
        assert jnp.abs(bent.q).max() > 1.0


@pytest.mark.stress(94)
def test_balance_past_the_critical_load_is_called_unstable_unless_the_load_follows():
    """A load along the tip has no other balance than straight up to flutter at 20.05 EI / L^2
    (Beck, ZAMP 3, 1952); one that keeps its direction at 2.47 has."""
    rod = planar(R.chebyshev(kappa_z=4), nodes=10)
    critical = np.pi**2 * EI / (4 * 0.08**2)

    @eqx.filter_jit
    def ends(share):
        wrench = critical * jnp.stack([jnp.zeros_like(share), -share, jnp.zeros_like(share)])
        loads = [R.PointWrench(wrench, follower=turns) for turns in (False, True)]
        path = R.equilibrium_path(rod, lambda f: (loads[0],), jnp.ones(2), begin=1.0)
        return [R.equilibrium(rod, (load,)).status for load in loads], path.status

    (dead, following), path = ends(jnp.array(6.0))
    assert dead == Status.unstable_equilibrium and following == Status.successful
    assert str(path) == "Status(unstable_equilibrium: 2)"
    (dead, following), path = ends(jnp.array(0.9))
    assert dead == following == Status.successful and str(path) == "Status(successful: 2)"


@pytest.mark.stress(8)
@pytest.mark.slow
def test_a_frame_stays_a_frame_for_a_million_steps():
    body = R.assembly(SE3(), body=R.Part(R.Link(1.0, [1.0, 2.0, 3.0]), R.Free()))
    v = jnp.array([1.0, 0.1, 0.2, 0.0, 0.0, 0.0])
    start = R.rest(body)
    film = R.rollout(body, start, v, step=1e-3, saves=10, every=100_000, stepper=RungeKutta4())
    size = jnp.sum(film.q[:, :4] ** 2, axis=1)
    assert film.status == Status.successful and jnp.abs(size - 1).max() <= 1e-12
    momenta = jax.vmap(lambda q, v: R.momentum(body, q, v)[:3])(film.q, film.v)
    assert jnp.abs(momenta - momenta[:1]).max() < 1e-8


@pytest.mark.stress(9)
@pytest.mark.parametrize("slenderness", [1e4, 20.0])
def test_slender_rods_do_not_lock(slenderness):
    section = R.circle(0.08 / slenderness, shear_factor=27 / 28)
    rod = R.rod(
        SE2(), R.chebyshev(kappa_z=3, sigma_y=3, sigma_x=2), section, nodes=10, **FINGER
    )
    bending = 1e6 * float(section.second_moment_z)
    load = 1e-3 * bending / 0.08**2
    rest = R.equilibrium(rod, (R.TipWrench([0.0, 0.0, load]),))
    shear = 1e6 / 2.6 * float(section.area) * 27 / 28
    exact = load * 0.08**3 / (3 * bending) + load * 0.08 / shear
    assert rest.status == Status.successful
    assert jnp.isclose(R.tip_pose(rod, rest.q)[1, 2], exact, rtol=1e-5)


@pytest.mark.stress(10)
@pytest.mark.parametrize("length", [0.0, -1e-3, np.nan])
def test_a_rod_without_length_is_refused(length):
    with pytest.raises(ValueError, match="length"):
        planar(R.constant("kappa_z"), length=length)
