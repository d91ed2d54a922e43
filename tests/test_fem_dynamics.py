"""Motion: order, energy, momentum, damping, restart, derivatives, lanes, bad input."""

import dataclasses
import io

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.equilibrium.newton import Secants
from sorojax.io.fields import export_fields

pytestmark = pytest.mark.quick

GRID = mesh.rectangle([0, 0], [0.1, 0.01], divisions=(6, 1), order=2)
SPACE = fem.space(GRID)
TIP = int(mesh.nearest_node(GRID, (0.1, 0.0)))
EXACT = fem.Newton(residual_tolerance=1e-12)
X = GRID.points


def _beam(young_modulus=1e6, held=True, loads=None) -> fem.Problem:
    pull = fem.Traction(GRID.facet_sets["right"], jnp.zeros(2), name="pull")
    rubber = material.neo_hookean(
        young_modulus=young_modulus, poisson_ratio=0.45, density=1000.0
    )
    return fem.problem(
        GRID,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        space=SPACE,
        free=not held,
        supports=(fem.Fixed(GRID.node_sets["left"]),) if held else (),
        loads=(pull,) if loads is None else loads,
    )


@pytest.fixture(scope="module")
def mode():
    """The first mode of the beam, 0.1 mm at the tip, and its period [s]."""
    modes = fem.eigenmodes(_beam(), count=1)
    shape = modes.shapes[0] * (1e-4 / jnp.max(jnp.abs(modes.shapes[0])))
    return shape, 1 / float(modes.frequencies[0])


def _tip(motion: fem.Trajectory) -> np.ndarray:
    return np.asarray(motion.displacements[:, TIP, 1])


@pytest.mark.parametrize(
    "method",
    [fem.Newmark(), fem.GeneralisedAlpha(0.5), fem.GeneralisedAlpha(1.0), fem.EnergyMomentum()],
    ids=lambda m: type(m).__name__,
)
def test_free_vibration_is_of_order_two_in_time(mode, method):
    shape, period = mode
    errors = []
    for count in (16, 32):
        motion = fem.simulate(
            _beam(), 1.25 * period, period / count, start=(shape, 0 * shape), method=method
        )
        angle = 2 * np.pi * np.asarray(motion.time) / period
        errors.append(np.abs(_tip(motion) - _tip(motion)[0] * np.cos(angle)).max() / 1e-4)
    assert 3.4 < errors[0] / errors[1] < 4.6, errors
    assert errors[1] < 0.05


def test_the_frequency_of_a_clamped_beam(mode):
    """Zero crossings against the first mode, from 50 steps per period on within 0.5 %."""
    shape, period = mode
    motion = fem.simulate(_beam(), 2.5 * period, period / 50, start=(shape, 0 * shape))
    times, tip = np.asarray(motion.time), _tip(motion)
    k = np.flatnonzero(tip[:-1] * tip[1:] < 0)
    crossings = times[k] - tip[k] * (times[k + 1] - times[k]) / (tip[k + 1] - tip[k])
    found = 2 * (crossings[-1] - crossings[0]) / (len(crossings) - 1)
    assert len(crossings) == 5
    assert abs(found / period - 1) < 5e-3


@pytest.fixture(scope="module")
def flight():
    """A body that turns, flies and vibrates without supports, twenty large steps."""
    turn = jnp.stack([-(X[:, 1] - 0.005), X[:, 0] - 0.03], axis=1)
    v = 40.0 * turn + jnp.asarray([1.0, 0.5])[None] + 0.5 * jnp.sin(40 * X)
    return fem.simulate(
        _beam(held=False),
        0.04,
        2e-3,
        start=(jnp.zeros_like(X), v),
        method=fem.EnergyMomentum(),
        newton=EXACT,
    )


def test_free_flight_keeps_momentum(flight):
    linear, angular = fem.momentum(flight)
    for row in (linear, angular):
        size = jnp.max(jnp.abs(row))
        np.testing.assert_allclose(row - row[:1], 0.0, atol=1e-10 * float(size))


def test_free_flight_keeps_energy(flight):
    """To 1e-6 a second of the total, in a body that stretches by several percent."""
    e = flight.energies
    assert float(jnp.max(e.elastic)) > 0.01 * float(e.kinetic[0])
    drift = jnp.abs(e.balance - e.balance[0]) / e.balance[0]
    assert float(jnp.max(drift)) < 1e-6 * 0.04
    np.testing.assert_allclose(e.balance, e.kinetic + e.elastic, rtol=1e-12)


def test_work_and_damping_close_the_balance():
    """What loads give and damping takes is what the body has, with a follower of time."""
    motion = fem.simulate(
        _beam(),
        0.02,
        5e-4,
        method=fem.EnergyMomentum(),
        newton=EXACT,
        damping=(fem.Rayleigh(5.0, 1e-4), fem.KelvinVoigt(50.0)),
        pull=lambda t: jnp.stack([jnp.zeros_like(t), 4e3 * jnp.sin(300 * t)]),
    )
    e = motion.energies
    total = float(jnp.max(jnp.abs(e.work)))
    assert float(e.dissipated[-1]) > 0.01 * total
    assert np.all(np.diff(np.asarray(e.dissipated)) >= 0)
    np.testing.assert_allclose(e.balance, 0.0, atol=1e-6 * 0.02 * total)


@pytest.mark.parametrize("kind", ["mass", "stiffness"])
def test_rayleigh_damping_has_the_ratio_of_its_docstring(mode, kind):
    shape, period = mode
    omega, ratio = 2 * np.pi / period, 0.05
    given = {"mass": 2 * ratio * omega, "stiffness": 2 * ratio / omega}
    motion = fem.simulate(
        _beam(),
        2 * period,
        period / 60,
        start=(shape, 0 * shape),
        damping=fem.Rayleigh(**{kind: given[kind]}),
    )
    found = -np.log(_tip(motion)[-1] / _tip(motion)[0]) / (4 * np.pi)
    assert abs(found / ratio - 1) < 0.02


def test_the_matrix_of_viscosity_at_rest_is_that_of_elasticity_without_bulk():
    """2 eta E in place of 2 mu E: the tangent at rest with mu = eta and lambda = 0."""
    eta, rest = 70.0, jnp.zeros_like(X)
    rubber = material.NeoHookean(shear_modulus=eta, bulk_modulus=2 / 3 * eta, density=1.0)
    problem = dataclasses.replace(_beam(), material=rubber)
    tangent = linearise(problem, prepare(problem), rest, rest).values
    matrix = fem.KelvinVoigt(eta).matrix(problem, fem.mass_matrix(problem), rest)
    np.testing.assert_allclose(matrix, tangent, atol=1e-11 * float(jnp.max(tangent)))


def test_viscosity_does_not_resist_rotation():
    """A body that only turns loses nothing to Kelvin-Voigt damping, much to Rayleigh's."""
    turn = jnp.stack([-(X[:, 1] - 0.005), X[:, 0] - 0.05], axis=1)
    rates = []
    for damping in (fem.KelvinVoigt(100.0), fem.Rayleigh(stiffness=3e-4)):
        motion = fem.simulate(
            _beam(held=False),
            0.04,
            1e-3,
            start=(0 * X, 5.0 * turn),
            method=fem.GeneralisedAlpha(1.0),
            damping=damping,
            save=2,
        )
        rates.append(float(motion.energies.dissipated[-1] / motion.energies.kinetic[0]))
    assert rates[0] < 1e-3 < 0.1 < rates[1], rates


def test_lumped_mass_and_prescribed_motion():
    """A shaken clamp gives the work that the body gets, with either mass."""
    problem = _beam()
    shaken = dataclasses.replace(
        problem,
        supports=(fem.Prescribed(GRID.node_sets["left"], jnp.zeros(2), name="clamp"),),
    )
    tips = []
    for mass in ("consistent", "lumped"):
        motion = fem.simulate(
            shaken,
            0.02,
            5e-4,
            mass=mass,
            save=11,
            method=fem.GeneralisedAlpha(1.0),
            clamp=lambda t: jnp.stack([0 * t, 2e-3 * (1 - jnp.cos(300 * t))]),
        )
        e = motion.energies
        assert len(motion) == 11
        assert float(e.work[-1]) > 0
        assert abs(float(e.balance[-1])) < 0.02 * float(jnp.max(e.work))
        tips.append(_tip(motion)[-1])
    assert abs(tips[1] / tips[0] - 1) < 0.1


def test_a_run_in_two_parts_is_the_whole_run_to_the_last_bit():
    def run(count, start):
        return fem.simulate(
            _beam(),
            count / 1024,
            1 / 1024,
            start=start,
            damping=fem.KelvinVoigt(30.0),
            pull=lambda t: jnp.stack([0 * t, 3e3 + 0 * t]),
        )

    whole, half = run(24, None), run(12, None)
    file = io.BytesIO()
    eqx.tree_serialise_leaves(file, half.end)
    file.seek(0)
    again = run(12, eqx.tree_deserialise_leaves(file, half.end))
    for a, b in zip(jax.tree.leaves(again.end), jax.tree.leaves(whole.end), strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(again.displacements, whole.displacements[12:])
    assert np.array_equal(again.energies.balance, whole.energies.balance[12:])


@pytest.mark.stress(39)
def test_a_step_a_hundred_times_too_large_settles(mode):
    """It ends at the statics of the load: stable, and far from exact in between."""
    period = mode[1]
    pull = jnp.asarray([0.0, 300.0])
    problem = _beam(loads=(fem.Traction(GRID.facet_sets["right"], pull, name="pull"),))
    still = fem.solve(problem).displacement
    motion = fem.simulate(problem, 60 * period, 2 * period)  # a step is 100 fiftieths
    assert motion.status == Status.successful
    assert float(jnp.max(jnp.abs(motion.displacements))) < 3 * float(jnp.max(jnp.abs(still)))
    np.testing.assert_allclose(motion.displacements[-1], still, atol=1e-2 * np.abs(still).max())


def test_steps_are_cut_where_they_fail_and_grow_again():
    """A sudden load that no single step of this size takes."""
    motion = fem.simulate(
        _beam(),
        0.05,
        0.01,
        save=2,
        newton=fem.Newton(max_iterations=2),
        throw=False,
        pull=lambda t: jnp.stack([0 * t, jnp.where(t > 0.015, 1.5e4, 0.0)]),
    )
    assert motion.status == Status.successful
    assert motion.stats.cuts > 0
    assert motion.stats.steps > 5
    assert float(motion.end.share) <= 1.0


def test_steps_follow_the_error(mode):
    shape, period = mode
    coarse, fine = (
        fem.simulate(
            _beam(), period, period / 4, start=(shape, 0 * shape), save=5, adaptive=adaptive
        )
        for adaptive in (False, 1e-3)
    )
    assert fine.stats.steps > 2 * coarse.stats.steps
    error = [abs(_tip(m)[-1] / _tip(m)[0] - 1) for m in (coarse, fine)]
    assert error[1] < 0.05 < error[0]


def _numbers(theta):
    """Height of the tip at the end [m], by modulus, viscosity, load and initial velocity."""
    young, viscosity, amplitude, speed = theta
    v = jnp.zeros_like(X).at[:, 1].set(speed * (X[:, 0] / 0.1) ** 2)
    motion = fem.simulate(
        _beam(young),
        4e-3,
        5e-4,
        start=(jnp.zeros_like(X), v),
        newton=EXACT,
        save=3,
        damping=fem.KelvinVoigt(viscosity),
        pull=lambda t: jnp.stack([jnp.zeros_like(t), amplitude * jnp.sin(200 * t)]),
    )
    return motion.displacements[-1, TIP, 1], motion.status


THETA = jnp.array([1e6, 100.0, 3e3, 0.5])


@pytest.fixture(scope="module")
def slope():
    return jax.grad(lambda theta: _numbers(theta)[0])(THETA)


def test_gradients_are_those_of_differences(slope):
    for k in range(4):
        d = jnp.zeros(4).at[k].set(1e-4 * THETA[k])
        change = (_numbers(THETA + d)[0] - _numbers(THETA - d)[0]) / (2 * d[k])
        np.testing.assert_allclose(slope[k], change, rtol=1e-6)


@pytest.mark.stress(45)
def test_lanes_have_their_own_status():
    """A lane without a number fails alone; the others are what they are alone."""
    lanes = jnp.stack([THETA, 1.1 * THETA, THETA.at[2].set(jnp.nan)])
    tips, status = jax.vmap(_numbers)(lanes)
    assert (status == Status.successful).tolist() == [True, True, False]
    np.testing.assert_allclose(tips[0], _numbers(THETA)[0], rtol=1e-9)
    np.testing.assert_allclose(tips[1], _numbers(1.1 * THETA)[0], rtol=1e-9)
    assert np.isnan(tips[2])


def test_inside_a_trace_it_is_the_same_motion(slope):
    tip, status = jax.jit(_numbers)(THETA)
    assert status == Status.successful
    np.testing.assert_allclose(tip, _numbers(THETA)[0], rtol=1e-9)


def test_secants_follow_a_change_of_low_rank():
    """An old factor and pairs of a matrix that has changed by rank 3 solve with the new one."""
    rng = np.random.default_rng(0)
    root, more = rng.normal(size=(40, 40)), 5 * rng.normal(size=(40, 3))
    old = root @ root.T + 40 * np.eye(40)
    new, secants, x = old + more @ more.T, Secants(), np.zeros(40)
    rhs, errors = rng.normal(size=40), []

    class Factor:
        def solve(self, b):
            return np.linalg.solve(old, b)

    for _ in range(15):
        step = secants.solve(Factor(), rhs - new @ x)
        errors.append(np.abs(rhs - new @ x).max())
        secants.add(step, new @ step)
        x = x + step
    assert np.allclose(secants.solve(Factor(), new @ step), step)
    plain = np.abs(np.linalg.matrix_power(np.eye(40) - np.linalg.solve(old, new), 14)).max()
    assert errors[-1] < 1e-6 * errors[0] and plain > 1e3
    secants.add(step, -step)  # of no use, left out
    assert np.allclose(secants.solve(Factor(), new @ step), step)


def test_a_motion_becomes_a_series_of_files(tmp_path):
    motion = fem.simulate(_beam(), 0.01, 5e-3, start=(0 * X, 0 * X + 0.1))
    files = export_fields(tmp_path / "beam.pvd", motion.problem, motion, fields=())
    assert [file.name for file in files] == [f"beam_000{k}.vtu" for k in range(3)] + [
        "beam.pvd"
    ]
    listed = files[-1].read_text()
    assert all(f'timestep="{float(t)!r}"' in listed for t in motion.time)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": 0.0}, "`step` must be positive"),
        ({"mass": "heavy"}, "need 'consistent' or 'lumped'"),
        ({"push": jnp.zeros(3)}, "got values for"),
        ({"pull": jnp.zeros((3, 2))}, "need \\(11, 2\\)"),
        ({"save": 1}, "`save` must be 2 or more"),
        ({"start": (jnp.zeros((3, 2)), X)}, "start displacement"),
        ({"damping": fem.KelvinVoigt(jnp.ones(5))}, "number or one per cell"),
    ],
)
def test_bad_input_names_the_remedy(change, message):
    settings = {"step": 0.1, **change}
    with pytest.raises(ValueError, match=message):
        fem.simulate(_beam(), 1.0, settings.pop("step"), **settings)


def test_a_run_that_fails_says_so():
    with pytest.raises(fem.MotionError, match="Take shorter steps") as caught:
        fem.simulate(
            _beam(),
            0.01,
            1e-3,
            max_cuts=1,
            newton=fem.Newton(max_iterations=1),
            pull=lambda t: jnp.stack([0 * t, 1e7 * t]),
        )
    assert caught.value.motion.status == Status.not_converged


def test_the_conserving_method_has_no_derivative():
    def end(young):
        motion = fem.simulate(_beam(young), 2e-3, 1e-3, method=fem.EnergyMomentum())
        return motion.displacements[-1, TIP, 1]

    with pytest.raises(ValueError, match="has no derivative"):
        jax.grad(end)(1e6)


def test_lumped_mass_is_shared_as_the_diagonal_of_the_consistent_one():
    """A straight Tri6 gives 1/19 of its mass to a corner and 16/57 to the middle of a side.

    Hinton, Rock, Zienkiewicz, Earthquake Eng. Struct. Dyn. 4, 1976.
    """
    grid = mesh.rectangle([0, 0], [1, 1], divisions=(1, 1), element=mesh.Tri6())
    rubber = material.NeoHookean(1e5, 1e6, density=1000.0)
    problem = fem.problem(grid, rubber, kinematics=fem.PlaneStrain(1.0), supports=(), free=True)
    shares = jnp.array([3.0, 3, 3, 16, 16, 16]) / 57
    want = jnp.zeros(grid.num_nodes).at[grid.cells].add(500.0 * shares[None])
    assert jnp.allclose(fem.lumped_mass(problem).reshape(-1, 2), want[:, None], rtol=1e-12)
