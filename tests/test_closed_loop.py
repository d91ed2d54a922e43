"""From drawings to closed loops: gradients beside differences, and what ends a chain."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import loops
from sorojax import SE2, Status, design, fem, material, mesh, reduction, rod, sdf, systems
from sorojax.units import kPa, ml, mm

closed_loop = sys.modules["sorojax.design.closed_loop"]
identification = sys.modules["sorojax.reduction.identify"]
SHORT = {"step": 5e-4, "solver": systems.Rosenbrock2()}  # compiles in a quarter of the time


@pytest.mark.slow
def test_every_number_from_drawing_to_controller_has_its_exact_slope():
    """Of a PneuNet; `python -m benchmarks reduction.gradient` has two more robots."""
    wide = {"num_chambers": 2, "slot_width": 2 * mm, "chamber_width": 2 * mm}
    robot = loops.pneunet(2.5 * mm, 0.05, states=4, **wide)
    loop = loops.Loop(robot, modes={"kappa_z": 2}, **SHORT)
    assert loop.near.status == Status.successful
    assert len(loop.varied) >= 15
    assert loop.error(jax.grad(loop.cost)(loop.numbers)) < 1e-4


# A tube that bends: one of its walls is thicker.


def tube(height, wall):
    """The outside with its chamber, [60 x `height`], a lower wall twice as thick."""
    outside = sdf.Rectangle(jnp.zeros(2), jnp.stack([60 * mm, height]))
    hollow = sdf.Rectangle(
        jnp.stack([10 * mm, 2 * wall]), jnp.stack([50 * mm, height - wall]), 1 * mm
    )
    return outside - hollow


START = jnp.array([12 * mm, 3 * mm])
RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)


@pytest.fixture(scope="module")
def start():
    cells = mesh.triangulate(tube(*START), size=3 * mm)
    (chamber,) = mesh.chambers(cells).volumes
    wall = mesh.chambers(cells).mesh.facet_sets[chamber]
    return fem.problem(
        cells,
        RUBBER,
        kinematics=fem.PlaneStrain(20 * mm),
        supports=(fem.Fixed(mesh.nodes_where(cells, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(wall, name="air"),),
        formulation=fem.Displacement(),
    )


def blown(pressure):
    """The body with a pressure that rises."""

    def network(body):
        air = systems.Source(systems.SmoothRamp([0.0, 0.1], [0.0, pressure]), unit="Pa")
        return systems.Network({"air": air, "body": body}, {"body.pressure": "air.value"})

    return network


LINE = reduction.Line([0.0, 3 * mm], [60 * mm, 3 * mm])


def chain(problem, dimensions, line=LINE, pressure=3 * kPa, **options):
    settings = {
        "solver": systems.Rosenbrock2(),
        "modes": {"kappa_z": 2},
        "samples": 21,
        "step": 1e-3,
        "save": 6,
        "degree": 2,
    }
    return design.drawing_to_loop(
        problem,
        None if dimensions is None else tube(*dimensions),
        line,
        options.pop("network", blown(pressure)),
        options.pop("duration", 0.1),
        damping=0.02,
        **(settings | {"air": jnp.linspace(0, pressure, 4)} | options),
    )


@pytest.fixture(scope="module")
def first(start):
    return chain(start, START)


def by_hand(problem, dimensions):
    points = mesh.move(problem.mesh, tube(*dimensions)).points
    moved = eqx.tree_at(lambda p: p.mesh.points, problem, points)
    path = fem.solve_path(moved, air=jnp.linspace(0, 3 * kPa, 4))
    backbone = reduction.strain_along(path, LINE, samples=21)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 2})
    fit = reduction.identify(path, basis, backbone, LINE, degree=2)
    body = rod.rod(SE2(), basis, fit.section, rod.elastic(RUBBER), length=fit.length)
    forces = (fit.elastic, fit.pressure, fit.damping(0.02))
    network = blown(3 * kPa)(systems.RodBody(body, forces))
    return systems.simulate(network, 0.1, save=6, step=1e-3, solver=systems.Rosenbrock2())


def test_one_call_is_the_chain_of_its_parts(start, first):
    film = by_hand(start, START)
    assert abs(float(first["body.tip_angle"][-1])) > 0.05
    for name in ("body.tip_angle", "body.volume"):
        np.testing.assert_allclose(first[name], film[name], rtol=1e-9)
    assert first.status == Status.successful
    assert all(bool(part == Status.successful) for part in first.parts)
    assert first.time[-1] == pytest.approx(0.1)
    assert "Trajectory from a drawing" in str(first)


def test_states_on_the_way_of_a_viscoelastic_body_give_no_law(start):
    """What they bear is in part what the branches remember."""
    rubber = material.Viscoelastic(RUBBER, material.Prony([0.5], [0.1]))
    silicone = eqx.tree_at(lambda p: p.material, start, rubber)
    with pytest.raises(ValueError, match="viscoelastic body over `times`, need equilibria"):
        chain(silicone, None, times=jnp.linspace(0.0, 1.0, 4))


def test_a_body_that_softens_gives_no_law_but_a_preconditioned_one_does(start, first):
    soft = material.Softening(RUBBER, r=2.0, m=1e3)
    with pytest.raises(ValueError, match="identify: got a body that softens"):
        chain(eqx.tree_at(lambda p: p.material, start, soft), None)
    before = material.preconditioned(soft, stretch=1.3)
    film = chain(eqx.tree_at(lambda p: p.material, start, before), None)
    angles = [float(run["body.tip_angle"][-1]) for run in (film, first)]
    assert film.status == Status.successful and abs(angles[0]) > 1.2 * abs(angles[1])


def test_an_output_that_does_not_come_to_rest_is_named(start, first):
    """The tip still moves while the pressure rises; it rests where it may move that much."""
    run = chain(start, START, near=first, settle=("body.tip_angle", 1e-6), throw=False)
    assert run.status == run.parts.loop == Status.not_settled
    assert bool(jnp.array_equal(run["body.tip_angle"], first["body.tip_angle"]))
    rest = chain(start, START, near=first, settle=("body.tip_angle", 1.0))
    assert rest.status == Status.successful


def turn(start, first, numbers):
    height, wall, shear, pressure = numbers
    problem = eqx.tree_at(lambda p: p.material.shear_modulus, start, shear)
    run = chain(problem, (height, wall), pressure=pressure, near=first)
    return run["body.tip_angle"][-1] + run["body.volume"][-1] / (4 * ml)


NUMBERS = jnp.array([*START, float(RUBBER.shear_modulus), 3 * kPa])


def central(function, x, step=1e-4):
    """Slopes by differences of fourth order, each times its number."""
    rows = []
    for way in np.diag(np.asarray(x) * step):
        at = {k: float(function(x + k * way)) for k in (-2, -1, 1, 2)}
        rows.append((8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step))
    return np.array(rows)


@pytest.fixture(scope="module")
def slopes(start, first):
    return central(lambda x: turn(start, first, x), NUMBERS)


def off(slope, slopes):
    return float(np.max(np.abs(np.asarray(slope * NUMBERS) - slopes)) / np.abs(slopes).max())


@pytest.mark.slow
def test_both_modes_of_differentiation_give_the_slopes(start, first, slopes):
    def at(x):
        return turn(start, first, x)

    reverse = jax.grad(at)(NUMBERS)
    assert off(reverse, slopes) < 1e-6
    way = NUMBERS * jnp.array([1.0, -0.7, 0.4, 0.2])
    forward = jax.jvp(at, (NUMBERS,), (way,))[1]
    assert float(forward) == pytest.approx(float(reverse @ way), rel=1e-9)


def held(function):
    """`function` without the derivative of what it returns."""

    def without(*args, **options):
        moving, rest = eqx.partition(function(*args, **options), eqx.is_inexact_array)
        return eqx.combine(jax.lax.stop_gradient(moving), rest)

    return without


@pytest.mark.parametrize(
    ("module", "rule"),
    [
        (closed_loop, "solve_path"),
        (closed_loop, "pod_basis"),
        (identification, "_condensed_stiffness"),
        (identification, "_volumes"),
    ],
)
def test_without_the_rule_of_one_part_the_slopes_are_wrong(
    module, rule, start, first, slopes, monkeypatch
):
    """A negative control: the comparison above sees every part."""
    monkeypatch.setattr(module, rule, held(getattr(module, rule)))
    found = jax.grad(lambda x: turn(start, first, x))(NUMBERS)
    assert off(found, slopes) > 1e-4, off(found, slopes)


# What ends a chain: an error where numbers are known, a status where they are traced.


def test_designs_in_one_batch_end_as_one_by_one(start, first):
    """The second is tangled: its walls are three times as thick."""
    designs = jnp.array([[12.0, 3.0], [30.0, 9.0], [12.1, 3.0]]) * mm

    def at(dimensions):
        run = chain(start, dimensions, near=first)
        return run["body.tip_angle"][-1], run.parts, run.status

    angles, parts, status = jax.vmap(at)(designs)
    one = chain(start, designs[2], near=first)
    np.testing.assert_allclose(angles[2], one["body.tip_angle"][-1], rtol=1e-8)
    np.testing.assert_allclose(angles[0], first["body.tip_angle"][-1], rtol=1e-8)
    np.testing.assert_array_equal(status == Status.successful, [True, False, True])
    np.testing.assert_array_equal(parts.mesh == Status.tangled, [False, True, False])


def test_a_design_that_tangles_its_mesh_is_refused(start, first):
    with pytest.raises(ValueError, match="move: .*mesh can follow"):
        chain(start, (30 * mm, 9 * mm), near=first)

    def at(wall):
        return chain(start, (30 * mm, wall), near=first)["body.tip_angle"][-1]

    with pytest.raises(ValueError, match="move: .*mesh can follow"):
        jax.grad(at)(jnp.array(9 * mm))


def test_a_curve_outside_the_body_is_refused(start, first):
    above = reduction.Line([0.0, 14 * mm], [60 * mm, 14 * mm])
    with pytest.raises(ValueError, match="lie outside the mesh.*Move the curve"):
        chain(start, START, above)
    with pytest.raises(RuntimeError, match="drawing_to_loop: curve: .*left the cells"):
        chain(start, START, above, near=first)
    run = chain(start, START, above, near=first, throw=False)
    assert bool(run.status == Status.outside_mesh)
    assert run.path is not None and run.basis is None and run.motion is None
    with pytest.raises(ValueError, match="no loop was simulated"):
        run.time  # noqa: B018


@pytest.mark.slow
def test_modes_that_vanish_are_refused(start, first):
    with pytest.raises(ValueError, match="pod_basis: asked for 5 modes"):
        chain(start, START, modes={"kappa_z": 5})
    still = {"air": jnp.zeros(4), "near": first}
    with pytest.raises(ValueError, match="pod_basis: asked for 2 .* hold 1 to 0"):
        chain(start, START, **still)
    run = jax.jit(lambda x: chain(start, x, **still).parts)(START)
    assert bool(run.modes == Status.too_few_states)


def test_a_pressure_without_equilibrium_ends_the_path(start, first):
    burst = {"pressure": 3000 * kPa, "newton": fem.Newton(max_iterations=6)}
    run = chain(start, START, throw=False, **burst)
    assert bool(run.parts.path == Status.not_converged) and run.backbone is None
    assert bool(run.status == Status.not_converged)


def unsettled(body):
    """A gain of the wrong sign, without limits, on the angle of the tip."""
    pid = systems.PID(4e5, low=-1e9, high=1e9)
    wires = {"body.pressure": "lag.value", "lag.a": "pid.command"}
    wires |= {"pid.measurement": "body.tip_angle", "pid.reference": "target.value"}
    blocks = {"body": body, "pid": pid, "lag": systems.Lag(1e-3, 0.0, unit="Pa")}
    blocks["target"] = systems.Source(systems.Constant(0.1), unit="rad")
    return systems.Network(blocks, wires)


def test_a_controller_that_runs_away_ends_the_loop(start, first):
    """The rod is stretched or turned beyond all bounds; what was found so far is kept."""
    run = chain(start, START, network=unsettled, near=first, throw=False, duration=2.0)
    assert not bool(run.parts.loop == Status.successful)
    assert bool(run.status == run.parts.loop)
    assert run.fit is not None and run.motion is not None
    with pytest.raises(RuntimeError, match="drawing_to_loop: loop: "):
        chain(start, START, network=unsettled, near=first, duration=2.0)


def test_wrong_calls_are_refused(start, first):
    with pytest.raises(ValueError, match="one of `network` and `duration`, need both"):
        chain(start, START, duration=None)
    with pytest.raises(ValueError, match="21 samples in a mesh of .* need 31"):
        chain(start, START, samples=31, near=first)
    with pytest.raises(ValueError, match="near` has {'kappa_z': 2}, need the same"):
        chain(start, START, modes={"kappa_z": 1}, near=first)
    alone = chain(start, None, network=None, duration=None, modes={"kappa_z": 0.99})
    assert alone.motion is None and alone.rod is not None
    np.testing.assert_allclose(alone.fit.length, 60 * mm, rtol=1e-12)
