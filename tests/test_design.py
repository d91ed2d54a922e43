"""Optimisers on problems with known answers, filters, and two classic layouts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.optimize

from sorojax import design, fem, material, mesh
from sorojax._progress import silent
from sorojax.math.status import Status


def beam_weight(x):
    return 0.0624 * jnp.sum(x)


def beam_deflection(x):
    return jnp.sum(jnp.array([61.0, 37.0, 19.0, 7.0, 1.0]) / x**3) - 1


@pytest.mark.parametrize("method", [design.MMA(1.0, 10.0), design.GCMMA(1.0, 10.0)])
@pytest.mark.versions
def test_svanbergs_beam(method):
    """Krister Svanberg, Int. J. Numer. Meth. Engng 24, 1987, section 5.2: 1.340."""
    found = design.minimise(
        beam_weight,
        jnp.full(5, 5.0),
        constraints=(beam_deflection,),
        optimiser=method,
        steps=60,
        tolerance=1e-6,
    )
    want = [6.0160, 5.3092, 4.4943, 3.5015, 2.1527]
    assert np.allclose(found.design, want, atol=2e-3) and abs(found.objective - 1.33996) < 1e-5
    assert float(found.constraints[0]) < 1e-6 and found.status == Status.successful


@pytest.mark.parametrize("method", [design.MMA(0.0, 5.0), design.GCMMA(0.0, 5.0)])
def test_svanbergs_two_balls(method):
    """The toy problem of the notes on MMA and GCMMA (KTH, 2007)."""
    centres = ([5.0, 2.0, 1.0], [3.0, 4.0, 3.0])

    def outside(centre, module=jnp):
        return lambda x: module.sum((x - module.array(centre)) ** 2) - 9

    found = design.minimise(
        lambda x: jnp.sum(x**2),
        jnp.array([4.0, 3.0, 2.0]),
        optimiser=method,
        steps=60,
        constraints=tuple(map(outside, centres)),
        tolerance=1e-7,
    )
    bounds = [{"type": "ineq", "fun": lambda x, c=c: -outside(c, np)(x)} for c in centres]
    peer = scipy.optimize.minimize(
        lambda x: np.sum(x**2), [4.0, 3.0, 2.0], constraints=bounds, method="SLSQP", tol=1e-12
    )
    assert np.allclose(found.design, peer.x, atol=1e-5)


def test_gcmma_never_rises_where_mma_may():
    """A function that MMA's fixed convexity misjudges."""

    def rough(x):
        return jnp.sum(x**2) + 0.5 * jnp.sum(jnp.cos(12 * x))

    start = jnp.array([0.9, -0.8, 0.4])
    careful = design.minimise(
        rough,
        start,
        optimiser=design.GCMMA(-1.0, 1.0),
        steps=30,
        constraints=(lambda x: jnp.sum(x) - 5,),
    )
    fall = np.diff(careful.history["objective"])
    assert np.all(fall <= 1e-7 * abs(careful.history["objective"][0]))
    assert careful.objective < rough(start) - 0.5


def test_a_step_beyond_where_a_function_is_defined_is_halved_until_it_is_not():
    found = design.minimise(
        lambda x: jnp.sum(-x - 0.01 * jnp.log(0.6 - x)),
        jnp.full(2, 0.5),
        optimiser=design.MMA(0.0, 1.0),
        constraints=(lambda x: jnp.sum(x) - 5,),
        steps=30,
    )
    assert found.status != Status.not_finite and jnp.all(jnp.abs(found.design - 0.55) < 0.05)


@pytest.mark.parametrize(
    ("objective", "best"),
    [
        (lambda x: x - 0.05 * jnp.log(x), 0.05),
        (lambda x: x**2 + 1 / jnp.sqrt(x), 0.25**0.4),
        (lambda x: jnp.where(x > 0, 1e-3 / x + x**2, jnp.nan), 5e-4 ** (1 / 3)),
    ],
)
def test_gcmma_proposes_again_nearer_where_a_function_is_not_defined(objective, best):
    found = design.minimise(
        lambda x: jnp.sum(objective(x)),
        jnp.array([1.9, 1.5]),
        optimiser=design.GCMMA(-50.0, 2.0),  # the functions end at 0
        tolerance=1e-4,
    )
    assert found.status == Status.successful
    assert np.allclose(found.design, best, atol=1e-3)


@pytest.mark.parametrize("double", [True, False])
def test_gcmma_calls_no_search_successful_that_rounding_ended(double):
    """The objective ends with a slope of minus infinity at 0, its optimum is at 1e-4."""
    with jax.enable_x64(double):
        found = design.minimise(
            lambda x: jnp.sum(x - 0.02 * jnp.sqrt(x)),
            jnp.array([1.9, 1.5]),
            optimiser=design.GCMMA(-50.0, 2.0),
            tolerance=1e-4,
        )
    assert found.status == Status.successful
    assert np.allclose(found.design, 1e-4, atol=1e-3)


def test_gcmma_that_finds_no_step_is_not_converged():
    """An objective with noise, which every proposal seems to lie below."""
    calls = iter(range(10**6))
    found = design.minimise(
        lambda x: jnp.sum(x**2) + jnp.asarray(1e-2 * next(calls)),
        jnp.array([1.9, 1.5]),
        optimiser=design.GCMMA(-50.0, 2.0),
        tolerance=1e-4,
    )
    assert found.status == Status.not_converged


def test_a_search_without_a_finite_proposal_says_so_and_keeps_its_design():
    start = jnp.array([1.9, 1.5])
    found = design.minimise(
        lambda x: jnp.where(jnp.all(x == start), jnp.sum(x**2), jnp.nan),
        start,
        optimiser=design.GCMMA(-50.0, 2.0),
    )
    assert found.status == Status.not_finite
    assert np.array_equal(found.design, start) and np.isfinite(found.objective)


def test_curvature_of_gcmma_after_a_proposal_that_was_too_good():
    """min(10 rho, 1.1 (rho + delta)), Svanberg 2002, eq. 4.12, with delta by the closed form of
    one variable between asymptotes at 0 and 1."""
    x, y, slope, value, found = 0.5, 0.6, 2.0, 1.0, 1.27
    method = design.GCMMA(0.0, 1.0)
    values = design.Values(value, jnp.array([slope]), jnp.zeros(0), jnp.zeros((0, 1)))
    state = method.begin(jnp.array([x]), values, method.init(jnp.array([x]), 0))
    rho = 0.1 * slope

    def told(rho):
        p, q = 0.25 * (1.001 * slope + rho), 0.25 * (0.001 * slope + rho)
        return value + p * (1 / (1 - y) - 2) + q * (1 / y - 2)

    delta = (found - told(rho)) / (told(1.0) - told(0.0))
    assert 0 < delta < 5 * rho
    stiffer, held = method.stiffen(
        jnp.array([x]), jnp.array([y]), values, (jnp.asarray(found), jnp.zeros(0)), state
    )
    assert not held
    assert np.allclose(stiffer.curvature, 1.1 * (rho + delta), rtol=1e-12)


def test_a_problem_without_a_feasible_point_ends_at_the_least_bad():
    found = design.minimise(
        lambda x: jnp.sum(x),
        jnp.array([0.5]),
        steps=40,
        constraints=(lambda x: 0.8 - x, lambda x: x - 0.2),
    )
    assert np.allclose(found.constraints, 0.3, atol=0.02)


@pytest.mark.versions
def test_any_optax_optimiser_and_any_pytree():
    start = {"a": jnp.array([2.0, -1.0]), "b": jnp.array(3.0)}
    found = design.minimise(
        lambda x: jnp.sum(x["a"] ** 2) + (x["b"] - 1) ** 2,
        start,
        optimiser=optax.adam(0.1),
        steps=400,
        tolerance=1e-8,
    )
    assert np.allclose(found.design["a"], 0, atol=1e-3) and abs(found.design["b"] - 1) < 1e-3
    with pytest.raises(ValueError, match="optax optimiser takes no constraints"):
        design.minimise(
            beam_weight, jnp.ones(5), constraints=(beam_deflection,), optimiser=optax.adam(0.1)
        )


def test_stopped_and_resumed_gives_the_same_bits():
    def run(steps, resume=None):
        return design.minimise(
            beam_weight,
            jnp.full(5, 5.0),
            constraints=(beam_deflection,),
            steps=steps,
            optimiser=design.MMA(1.0, 10.0),
            tolerance=0.0,
            scale=1.0,
            resume=resume,
        )

    whole, half = run(12), run(6)
    rest = run(12, half.last)
    assert np.array_equal(whole.design, rest.design)
    assert np.array_equal(whole.history["objective"][6:], rest.history["objective"])


def test_values_that_break_are_named_or_stop_the_run():
    with pytest.raises(ValueError, match="not finite at the first design|objective is nan"):
        design.minimise(lambda x: jnp.sum(jnp.log(x)), jnp.array([-1.0]))
    with silent():
        found = design.minimise(
            lambda x: jnp.sum(x) + 0 * jnp.sum(jnp.log(x - 0.4)),
            jnp.array([0.9]),
            optimiser=optax.sgd(0.3),
            steps=10,
        )
    assert found.status == Status.not_finite and np.all(np.isfinite(found.design))


def test_a_design_that_a_function_refuses_is_named_and_the_last_good_one_kept():
    """As `drawing_to_loop` refuses a drawing whose mesh is tangled, by an error."""

    def thin(x):
        if float(jax.lax.stop_gradient(x[0])) < 0.3:
            raise RuntimeError("the mesh is tangled.")
        return x[0] ** 2

    with pytest.warns(UserWarning, match="step 1 went to a design that fails: the mesh is"):
        found = design.minimise(thin, jnp.array([0.9]), optimiser=optax.sgd(0.4), steps=9)
    assert found.status == Status.not_finite
    assert 0.3 <= float(found.design[0]) < 0.5
    with pytest.raises(RuntimeError, match="tangled"):
        design.minimise(thin, jnp.array([0.1]), steps=2)


GRID = mesh.rectangle([0, 0], [12.0, 6.0], divisions=(12, 6), element=mesh.Quad4())


@pytest.mark.parametrize("make", [design.cone_filter, design.helmholtz_filter])
def test_filters_keep_a_constant_and_smooth(make):
    smooth = make(GRID, 2.5)
    assert np.allclose(smooth(jnp.full(72, 0.3)), 0.3, rtol=1e-12)
    spike = jnp.zeros(72).at[40].set(1.0)
    out = smooth(spike)
    assert out.min() > -0.02 and out[40] == out.max() < 0.6
    weights = jnp.linspace(0.0, 1.0, 72)
    back = jax.vjp(smooth, spike)[1](weights)[0]
    assert jnp.vdot(weights, smooth(spike)) == pytest.approx(float(back[40]), rel=1e-12)


def test_the_cone_filter_is_a_weighted_mean():
    """Radius 1.5 on unit squares: weights 1.5, 0.5 and 1.5 - sqrt 2."""
    smooth = design.cone_filter(GRID, 1.5)
    middle = np.argmin(
        np.linalg.norm(
            np.asarray(GRID.points)[np.asarray(GRID.cells)].mean(axis=1) - [5.5, 2.5], axis=1
        )
    )
    out = smooth(jnp.zeros(72).at[middle].set(1.0))
    corner = 1.5 - np.sqrt(2)
    total = 1.5 + 4 * 0.5 + 4 * corner
    want = sorted([1.5 / total, *4 * [0.5 / total], *4 * [corner / total]])
    assert np.allclose(sorted(np.asarray(out[out > 0])), want, rtol=1e-12)


def test_projection_is_monotone_and_exact_at_its_ends():
    x = jnp.linspace(0.0, 1.0, 101)
    for sharpness in (0.1, 4.0, 64.0):
        y = design.heaviside_projection(x, sharpness, 0.4)
        assert np.allclose([y[0], y[-1]], [0, 1], atol=1e-12) and np.all(np.diff(y) >= 0)
    assert design.greyness(design.heaviside_projection(x, 64.0)) < 0.1


def mbb(nx, ny):
    """Half of a beam on two supports under a force in the middle; E = 1, nu = 0.3."""
    grid = mesh.rectangle([0, 0], [nx, ny], divisions=(nx, ny), element=mesh.Quad4())
    left = fem.Fixed(grid.node_sets["left"], components=(0,))
    foot = fem.Fixed(jnp.array([mesh.nearest_node(grid, [nx, 0.0])]), components=(1,))
    push = fem.Force(jnp.array([mesh.nearest_node(grid, [0.0, ny])]), [0.0, -1.0])
    stuff = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3)
    return fem.problem(
        grid,
        stuff,
        kinematics=fem.PlaneStress(1.0),
        supports=(left, foot),
        loads=(push,),
        formulation=fem.Displacement(),
    )


@pytest.fixture(scope="module")
def small():
    problem = mbb(12, 6)
    return problem, design.linear(problem)


def test_small_displacements_are_those_of_the_nonlinear_body(small):
    problem, model = small
    factor = jnp.linspace(0.3, 1.0, 72)
    u = design.displacement(model, factor)
    soft = fem.problem(
        problem.mesh,
        material.Scaled(problem.material, 1e6 * factor),
        loads=problem.loads,
        kinematics=problem.kinematics,
        supports=problem.supports,
        formulation=fem.Displacement(),
    )
    exact = 1e6 * fem.solve(soft).displacement
    assert np.max(np.abs(u - exact)) < 1e-3 * np.max(np.abs(u))


def test_the_gradient_of_compliance(small):
    _, model = small
    interpolation = design.Simp(3.0, 1e-6)

    def loss(x):
        return design.compliance(model, interpolation(x))

    x, way = jnp.linspace(0.2, 0.9, 72), jnp.cos(jnp.arange(72.0))
    slope = jnp.vdot(jax.grad(loss)(x), way)
    h = 1e-6
    difference = (loss(x + h * way) - loss(x - h * way)) / (2 * h)
    assert float(slope) == pytest.approx(float(difference), rel=1e-7)

    def through(x):  # the same by the adjoint of the solve
        return jnp.sum(model.force * design.displacement(model, interpolation(x)))

    assert np.allclose(jax.grad(through)(x), jax.grad(loss)(x), rtol=1e-9)
    # and their second derivatives
    curve = jax.jvp(jax.grad(loss), (x,), (way,))[1] @ way
    change = (jax.grad(loss)(x + h * way) - jax.grad(loss)(x - h * way)) @ way / (2 * h)
    assert float(curve) == pytest.approx(float(change), rel=1e-6)
    assert float(jax.jvp(jax.grad(through), (x,), (way,))[1] @ way) == pytest.approx(curve)


def test_a_displacement_moves_with_cells_loads_and_springs(small):
    """Every number that it is made of, in both directions."""
    _, model = small
    factor, way = jnp.linspace(0.2, 0.9, 72), jnp.cos(jnp.arange(1.0 * model.force.size))

    def end(scale):
        changed = eqx.tree_at(
            lambda m: (m.stiffness, m.others),
            model,
            (scale[0] * model.stiffness, scale[1] * model.stiffness.max() + model.others),
        )
        u = design.displacement(changed, factor, scale[2] * model.force)
        return u.ravel() @ way

    at, h = jnp.array([1.1, 0.01, 0.8]), 1e-6
    want = [float(end(at.at[k].add(h)) - end(at.at[k].add(-h))) / (2 * h) for k in range(3)]
    assert np.allclose(jax.grad(end)(at), want, rtol=1e-6)
    assert np.allclose(jax.jacfwd(end)(at), want, rtol=1e-6)


@pytest.mark.versions
def test_compiled_functions_and_others_take_the_same_steps():
    """Few programs for compiled functions, one after the other for those that are not."""
    functions = (beam_weight, beam_deflection, lambda x, g: g / (1 + x / 100))
    designs = []
    for make in (lambda f: f, jax.jit):
        loss, held, changed = map(make, functions)
        found = design.minimise(
            loss,
            jnp.full(5, 5.0),
            constraints=(held,),
            optimiser=design.MMA(1.0, 10.0),
            change_gradient=changed,
            steps=5,
        )
        designs.append(found.design)
    assert np.allclose(*designs, rtol=1e-12)


@pytest.mark.parametrize("target", [0.3, 0.62, 0.05])
def test_optimality_criteria_meet_the_volume_within_their_limits(target):
    """Also where it is out of reach of a step: as near as the step comes then."""
    random = np.random.default_rng(0)
    x, gain = jnp.asarray(random.uniform(0.2, 0.8, 50)), jnp.asarray(random.uniform(1, 5, 50))
    slopes = jnp.full((1, 50), 1 / 50)
    values = design.Values(jnp.asarray(1.0), -gain, jnp.mean(x)[None] - target, slopes)
    new, _ = design.OptimalityCriteria().update(x, values, None)
    assert np.all(np.abs(new - x) <= 0.2 + 1e-12)
    reach = jnp.mean(jnp.maximum(x - 0.2, 0.0))
    assert float(jnp.mean(new)) == pytest.approx(max(target, float(reach)), abs=1e-12)


@pytest.mark.parametrize(("kind", "want"), [("sensitivity", 216.8137), ("density", 233.7146)])
def test_the_mbb_beam(kind, want):
    """60 x 20, volume 0.5, exponent 3, radius 2.4: the numbers of the 88-line code."""
    problem = mbb(60, 20)
    model, smooth = design.linear(problem), design.cone_filter(problem.mesh, 2.4)
    interpolation = design.Simp(3.0, 1e-9)
    if kind == "density":
        loss = jax.jit(lambda x: design.compliance(model, interpolation(smooth(x))))
        volume = jax.jit(lambda x: jnp.mean(smooth(x)) - 0.5)
        changed = None
    else:
        loss = jax.jit(lambda x: design.compliance(model, interpolation(x)))
        volume = jax.jit(lambda x: jnp.mean(x) - 0.5)
        changed = lambda x, g: design.sensitivity_filtered(smooth, x, g)  # noqa: E731
    with silent():
        found = design.minimise(
            loss,
            jnp.full(1200, 0.5),
            constraints=(volume,),
            steps=200,
            tolerance=0.01,
            optimiser=design.OptimalityCriteria(),
            change_gradient=changed,
        )
    assert float(found.history["objective"][-1]) == pytest.approx(want, rel=5e-3)
    assert abs(float(found.constraints[0])) < 1e-3


def inverter(nx, ny):
    """Half of a mechanism that turns a push at the left into a pull at the right."""
    grid = mesh.rectangle([0, 0], [nx, ny], divisions=(nx, ny), element=mesh.Quad4())
    ends = jnp.array([mesh.nearest_node(grid, [x, ny]) for x in (0.0, nx)])
    ground = grid.points[ends] - jnp.array([[10.0, 0.0], [-10.0, 0.0]])
    corner = mesh.nodes_where(grid, lambda p: (p[0] <= 0) & (p[1] <= 3.5))
    held = (fem.Fixed(grid.node_sets["top"], components=(1,)), fem.Fixed(corner))
    springs = fem.Spring(ends, ground, 0.1)
    problem = fem.problem(
        grid,
        material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3),
        supports=held,
        kinematics=fem.PlaneStress(1.0),
        loads=(fem.Force(ends[:1], [1.0, 0.0]), springs),
        formulation=fem.Displacement(),
    )
    return problem, ends[1]


def test_the_force_inverter():
    """40 x 20, volume 0.3, radius 1.2, springs of 0.1: published -1.113."""
    problem, end = inverter(40, 20)
    model, smooth = design.linear(problem), design.cone_filter(problem.mesh, 1.2)
    interpolation = design.Simp(3.0, 1e-9)
    out = jax.jit(lambda x: design.displacement(model, interpolation(x))[end, 0])
    volume = jax.jit(lambda x: 10 * (jnp.mean(x) - 0.3))
    with silent():
        found = design.minimise(
            out,
            jnp.full(800, 0.3),
            constraints=(volume,),
            steps=120,
            tolerance=0.01,
            optimiser=design.MMA(1e-3, 1.0, move=0.1),
            scale=0.1,
            change_gradient=lambda x, g: design.sensitivity_filtered(smooth, x, g),
        )
    assert float(found.objective) < -1.113 and abs(float(found.constraints[0])) < 0.02


def test_the_stiffness_of_a_sheet_is_differentiated_by_its_material():
    # the stretch out of the plane follows the material too, to second order
    grid = mesh.rectangle([0, 0], [3, 1], divisions=(3, 1), element=mesh.Quad4())
    pull = fem.Force([mesh.nearest_node(grid, [3.0, 0.0])], [0.0, -1.0])

    def compliance(poisson_ratio):
        sheet = fem.problem(
            grid,
            material.neo_hookean(young_modulus=10.0, poisson_ratio=poisson_ratio),
            kinematics=fem.PlaneStress(1.0),
            supports=(fem.Fixed(grid.node_sets["left"]),),
            loads=(pull,),
            formulation=fem.Displacement(),
        )
        return design.compliance(design.linear(sheet), jnp.ones(grid.num_cells))

    slope, h = jax.grad(compliance)(0.3), 1e-5
    difference = (compliance(0.3 + h) - compliance(0.3 - h)) / (2 * h)
    assert np.isclose(slope, difference, rtol=1e-6)
