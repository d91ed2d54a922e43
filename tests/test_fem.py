"""Equilibrium: patch, beam, invariance, derivatives, cost, bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.equilibrium.response import tangent_solve
from sorojax.mesh import Mesh
from sorojax.units import kPa, mm

pytestmark = pytest.mark.quick

RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.49, density=1000.0)


def _distorted(order: int) -> Mesh:
    """A unit square of triangles with its inner corners moved."""
    grid = mesh.rectangle([0, 0], [1, 1], divisions=(3, 3), order=order)
    X, cells = np.array(grid.points), np.asarray(grid.cells)
    inner = np.all((X > 0.01) & (X < 0.99), axis=1)
    corners = np.isin(np.arange(len(X)), cells[:, :3])
    shift = np.random.default_rng(0).uniform(-0.06, 0.06, X.shape)
    X[inner & corners] += shift[inner & corners]
    if order == 2:
        for a, b, middle in ((0, 1, 3), (1, 2, 4), (2, 0, 5)):
            X[cells[:, middle]] = (X[cells[:, a]] + X[cells[:, b]]) / 2
    return Mesh(X, cells, grid.element)


def _beam(traction=None, rubber=RUBBER, divisions=(40, 2), height=0.005) -> fem.Problem:
    grid = mesh.rectangle([0, 0], [0.1, height], divisions=divisions, order=2)
    loads = ()
    if traction is not None:
        loads = (fem.Traction(grid.facet_sets["right"], traction),)
    supports = (fem.Fixed(grid.node_sets["left"]),)
    kinematics = fem.PlaneStrain(1.0)
    return fem.problem(grid, rubber, kinematics=kinematics, supports=supports, loads=loads)


def _ring(pressure=20 * kPa, rubber=RUBBER, thickness=0.02) -> fem.Problem:
    """A square tube under inner pressure, held at one outer side."""
    outer = mesh.rectangle([0, 0], [0.03, 0.03], divisions=(6, 6), order=2)
    centres = np.asarray(outer.points)[np.asarray(outer.cells)[:, :3]].mean(axis=1)
    keep = np.any(np.abs(centres - 0.015) > 0.01, axis=1)
    used, cells = np.unique(np.asarray(outer.cells)[keep], return_inverse=True)
    tube = Mesh(np.asarray(outer.points)[used], cells.reshape(-1, 6), outer.element)
    wall = mesh.facets_where(tube, lambda p: jnp.all(jnp.abs(p - 0.015) < 0.0101))
    left = mesh.nodes_where(tube, lambda p: p[0] < 1e-9)
    return fem.problem(
        tube,
        rubber,
        kinematics=fem.PlaneStrain(thickness),
        supports=(fem.Fixed(left),),
        loads=(fem.Pressure(wall, pressure, name="air"),),
    )


@pytest.mark.parametrize("order", [1, 2])
def test_patch_of_distorted_cells_holds_a_linear_field(order):
    square = _distorted(order)
    edge = np.unique(mesh.boundary_facets(square))
    G = jnp.array([[0.2, 0.1], [-0.05, -0.1]])
    exact = square.points @ G.T
    problem = fem.problem(
        square,
        RUBBER,
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Prescribed(edge, exact[edge]),),
        formulation=fem.Displacement(),
    )
    solution = fem.solve(problem)
    assert jnp.max(jnp.abs(solution.displacement - exact)) < 1e-12
    stress = fem.cauchy_stress(problem, solution.displacement)
    assert jnp.ptp(stress[..., 0, 0]) < 1e-9 * jnp.max(jnp.abs(stress))


def test_clamped_beam_bends_as_beam_theory_says():
    E, nu, height = 1e6, 0.3, 0.005
    rubber = material.neo_hookean(young_modulus=E, poisson_ratio=nu)
    problem = _beam(jnp.array([0.0, 0.02]), rubber)
    tip = mesh.nearest_node(problem.mesh, [0.1, height / 2])
    deflection = fem.solve(problem).displacement[tip, 1]
    force, inertia = 0.02 * height, height**3 / 12
    bending = force * 0.1**3 / (3 * E / (1 - nu**2) * inertia)
    shear = force * 0.1 / (5 / 6 * E / (2 * (1 + nu)) * height)
    # the clamp also stops the lateral contraction: 0.3 % at this slenderness
    assert jnp.allclose(deflection, bending + shear, rtol=4e-3)


def test_a_clamped_beam_converges_at_the_rate_of_its_corners():
    """Tip deflection under self weight; the corners of the clamp, where stress is singular,
    keep the rate between 1.5 and 2."""

    def tip(n):
        beam = mesh.rectangle([0, 0], [0.08, 0.02], divisions=(4 * n, n), order=2)
        problem = fem.problem(
            beam,
            material.neo_hookean(young_modulus=1e5, poisson_ratio=0.45, density=1000.0),
            kinematics=fem.PlaneStrain(1.0),
            supports=(fem.Fixed(beam.node_sets["left"]),),
            loads=(fem.Gravity(),),
        )
        return fem.solve(problem).displacement[mesh.nearest_node(beam, [0.08, 0.01]), 1]

    coarse, middle, fine = (float(tip(n)) for n in (2, 4, 8))
    assert np.log2(abs((middle - coarse) / (fine - middle))) > 1.5


def test_rigid_motion_leaves_energy_and_force_at_zero():
    problem = _beam()
    turn = 0.7
    R = jnp.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    u = problem.mesh.points @ (R - jnp.eye(2)).T + jnp.array([[0.3, -0.2]])
    assert abs(fem.potential_energy(problem, u)) < 1e-15 * 1e6
    assert jnp.max(jnp.abs(fem.residual(problem, u))) < 1e-8


def test_assembled_force_and_tangent_are_derivatives_of_the_energy(getkey):
    problem = _ring()
    u = 1e-4 * jax.random.normal(getkey(), problem.mesh.points.shape)
    prepared = prepare(problem)
    state = linearise(problem, prepared, u, u)
    force = jax.grad(fem.potential_energy, argnums=1)(problem, u).ravel()
    assert jnp.allclose(state.residual, force, rtol=0, atol=1e-11 * jnp.max(jnp.abs(force)))
    direction = jax.random.normal(getkey(), u.shape)
    _, change = jax.jvp(lambda u: fem.residual(problem, u), (u,), (direction,))
    from sorojax.math.linalg import sparse

    product = sparse.product(problem.space.system, state.values, direction.ravel())
    scale = jnp.max(jnp.abs(change))
    assert jnp.max(jnp.abs(product - change.ravel())) < 1e-11 * scale


def test_closed_cavity_exerts_no_net_force_and_works_p_dv():
    problem = _ring()
    solution = fem.solve(problem)
    u, facets = solution.displacement, problem.loads[0].facets
    left = problem.supports[0].nodes
    pushed = 20 * kPa * 0.02 * 0.02  # pressure x wall length x thickness [N]
    assert jnp.max(jnp.abs(fem.reaction_force(problem, u, left))) < 1e-8 * pushed
    volume, rate = jax.jvp(
        lambda u: fem.enclosed_volume(problem, u, facets), (u,), (jnp.ones_like(u),)
    )
    assert jnp.allclose(fem.enclosed_volume(problem, 0 * u, facets), 0.02**3, rtol=1e-12)
    assert volume > 0.02**3 and abs(rate) < 1e-15


@pytest.mark.parametrize("leaf", ["pressure", "shear", "thickness", "points"])
def test_gradients_of_equilibrium_agree_with_central_differences(leaf):
    base = _ring(8 * kPa)
    where = {
        "pressure": lambda p: p.loads[0].value,
        "shear": lambda p: p.material.shear_modulus,
        "thickness": lambda p: p.kinematics.thickness,
        "points": lambda p: p.mesh.points,
    }[leaf]
    start = where(base)
    wave = jnp.sin(200 * start[:, ::-1]) * 1e-3 if leaf == "points" else start
    tight = fem.Newton(residual_tolerance=1e-12)

    def answer(scale):
        problem = eqx.tree_at(where, base, start + scale * wave)
        u = fem.solve(problem, newton=tight).displacement
        return jnp.sum(u[:, 0] * jnp.cos(100 * problem.mesh.points[:, 1])) * 1e3

    h = 1e-3
    exact = jax.grad(answer)(jnp.array(0.0))
    ahead = jax.jvp(answer, (jnp.array(0.0),), (jnp.array(1.0),))[1]
    values = [answer(jnp.array(k * h)) for k in (-2, -1, 1, 2)]
    difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    assert jnp.allclose(exact, ahead, rtol=1e-10, atol=1e-12)
    assert jnp.allclose(exact, difference, rtol=1e-7, atol=1e-9)


@pytest.mark.versions
def test_gradient_of_a_prescribed_displacement():
    grid = _distorted(1)  # the kernels of the patch
    left, right = (mesh.nodes_where(grid, lambda p, x=x: p[0] == x) for x in (0.0, 1.0))

    def energy(stretch):
        moved = jnp.stack([stretch, jnp.zeros_like(stretch)])
        problem = fem.problem(
            grid,
            RUBBER,
            kinematics=fem.PlaneStrain(1.0),
            supports=(fem.Fixed(left), fem.Prescribed(right, moved)),
            formulation=fem.Displacement(),
        )
        return fem.potential_energy(problem, fem.solve(problem).displacement)

    stretch, h = jnp.array(0.2), 1e-4
    exact = jax.grad(energy)(stretch)
    assert jnp.allclose(exact, (energy(stretch + h) - energy(stretch - h)) / (2 * h), rtol=1e-6)


def test_answer_does_not_depend_on_the_load_steps():
    problem = _ring(30 * kPa)
    once, often = fem.solve(problem), fem.solve(problem, steps=7)
    assert len(often.stats.steps) > len(once.stats.steps)
    largest = jnp.max(jnp.abs(once.displacement))
    assert jnp.max(jnp.abs(once.displacement - often.displacement)) < 1e-8 * largest


def _pulled(move=0.0, angle=0.0) -> fem.Problem:
    """A bar whose right end is moved, or turned by a support of its own kind."""
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(4, 1), element=mesh.Quad9())
    right = bar.node_sets["right"]
    ends = {
        "moved": fem.Prescribed(right, [move, 0.0], name="end"),
        "turned": fem.Rotated(right, bar.points[right], angle, [0.04, 0.005], name="end"),
    }
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
    supports = (fem.Fixed(bar.node_sets["left"]), ends["turned" if angle else "moved"])
    return fem.problem(bar, rubber, kinematics=fem.PlaneStrain(0.01), supports=supports)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["host", "jit"])
def test_a_path_follows_a_support_that_moves(wrap):
    """Each state is that of a problem with the support there, and so are slopes."""
    rows, problem = jnp.array([[2 * mm, 0.0], [4 * mm, 1 * mm]]), _pulled()
    nodes = problem.supports[1].nodes

    def pull(rows):
        path = fem.solve_path(problem, end=rows)
        last = path.problem_under(path.loading[-1])
        return path.displacements, fem.reaction_force(last, path.displacements[-1], nodes)

    u, force = wrap(pull)(rows)
    assert jnp.allclose(u[:, nodes], rows[:, None], atol=1e-12)
    for state, row in zip(u, rows, strict=True):
        alone = fem.solve(fem.with_load(problem, "end", row)).displacement
        assert jnp.allclose(state, alone, atol=1e-9)
    ways = jnp.zeros_like(rows).at[1, 0].set(1.0)
    slope = wrap(lambda rows: jax.jvp(lambda r: pull(r)[1], (rows,), (ways,))[1])(rows)
    step = 1e-6
    seen = (pull(rows + step * ways)[1] - pull(rows - step * ways)[1]) / (2 * step)
    assert force[0] > 0 and jnp.allclose(slope, seen, rtol=1e-6)


def test_a_path_turns_a_support_along_its_arc():
    path = fem.solve_path(_pulled(angle=0.1), end=jnp.array([0.3, 0.9]))
    turned = path.problem_under(path.loading[-1])
    assert float(turned.supports[1].angle) == 0.9
    alone = fem.solve(turned).displacement
    assert jnp.allclose(path.displacements[-1], alone, atol=1e-9)


def test_supports_of_a_path_are_named():
    with pytest.raises(ValueError, match=r"need exactly one of .* \['end'\]"):
        fem.solve_path(_pulled(), fixed=jnp.zeros((1, 2)))
    with pytest.raises(ValueError, match="has shape"):
        fem.solve_path(_pulled(), end=jnp.zeros(3))
    two = eqx.tree_at(
        lambda p: p.supports, _pulled(), _pulled().supports + _pulled().supports[1:]
    )
    with pytest.raises(ValueError, match="2 loads or moved supports are called 'end'"):
        fem.solve_path(two, end=jnp.zeros((1, 2)))


def test_a_path_has_small_residuals_and_needs_few_iterations():
    path = fem.solve_path(_ring(), air=jnp.linspace(0, 20 * kPa, 5))
    steps = [step for stats in path.stats for step in stats.steps]
    assert path.status == Status.successful and len(path) == 5
    assert max(step.residual for step in steps) < 1e-8
    assert sum(step.iterations for step in steps) <= 20
    assert all(step.negative_eigenvalues == 0 for step in steps)


def test_a_load_beyond_reach_keeps_the_last_converged_state():
    problem = _ring(5e8)
    with pytest.raises(
        fem.ConvergenceError, match="no equilibrium.*solve_volume.*arc length"
    ) as error:
        fem.solve(problem, max_cuts=2)
    solution = fem.solve(problem, max_cuts=2, throw=False)
    assert solution.status == Status.not_converged and solution.stats.reason
    assert jnp.all(jnp.isfinite(solution.displacement))
    assert jnp.array_equal(error.value.solution.displacement, solution.displacement)


@pytest.mark.versions
def test_numbers_do_not_retrace_the_kernels():
    problem = _ring()
    fem.solve(problem)
    before = asm.assemble._cache_size()
    for pressure in (3 * kPa, 5 * kPa):
        fem.solve(eqx.tree_at(lambda p: p.loads[0].value, problem, jnp.asarray(pressure)))
    assert asm.assemble._cache_size() == before


def test_largest_step_keeps_a_tenth_of_every_volume(getkey):
    problem = _beam()
    prepared = prepare(problem)
    du = 0.05 * jax.random.normal(getkey(), problem.mesh.points.shape)
    zero = jnp.zeros_like(du)
    args = (problem.space, prepared.geometry, problem.kinematics, zero)
    fraction = asm.largest_step(*args, du, keep=0.1)
    state = linearise(problem, prepared, fraction * du, zero)
    beyond = linearise(problem, prepared, fraction / 0.75 * du, zero)
    assert 0 < fraction < 1 and state.volume_ratio >= 0.1 > beyond.volume_ratio


def _bad(**changes):
    grid = mesh.rectangle([0, 0], [0.1, 0.02], divisions=(3, 1), order=1)
    arguments = {
        "mesh": grid,
        "material": RUBBER,
        "kinematics": fem.PlaneStrain(20 * mm),
        "supports": (fem.Fixed(grid.node_sets["left"]),),
        "loads": (),
        "formulation": fem.Displacement(),
    } | changes
    return fem.problem(arguments.pop("mesh"), arguments.pop("material"), **arguments)


_FLIPPED = Mesh(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 2, 1]]), mesh.Tri3())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"supports": ()}, "3 rigid-body mode"),
        ({"supports": (fem.Fixed(np.array([0])),)}, "1 rigid-body mode"),
        ({"supports": (fem.Fixed(np.array([], int)),)}, "holds no node"),
        ({"supports": (fem.Fixed(np.array([0, 99])),)}, "names nodes 0 to 99"),
        ({"mesh": _FLIPPED, "supports": (fem.Fixed(np.arange(3)),)}, "inverted or flat"),
        ({"loads": (fem.Pressure(np.zeros((0, 2), int)),)}, "acts on no facet"),
        ({"loads": (fem.Pressure(np.array([[1, 3]])),)}, "an open end at nodes"),
        ({"loads": (fem.Gravity(), fem.Gravity())}, "need different names"),
        (
            {"loads": (fem.Gravity(),), "material": material.NeoHookean(1e5, 1e6)},
            "needs a density",
        ),
        ({"material": material.Scaled(RUBBER, np.ones(5))}, "one number per cell"),
    ],
)
def test_bad_problems_are_refused_before_any_long_computation(changes, message):
    with pytest.raises(ValueError, match=message):
        _bad(**changes)


def test_bad_calls_name_the_remedy():
    problem = _ring()
    with pytest.raises(ValueError, match="exactly one of the loads"):
        fem.solve_path(problem, gas=jnp.linspace(0, 1, 3))
    with pytest.raises(ValueError, match="must be positive"):
        fem.PlaneStrain(-1.0)


def test_a_body_without_load_is_an_equilibrium_at_rest():
    solution = fem.solve(_ring(0.0))
    assert solution.stats.iterations <= 2 and solution.stats.cuts == 0
    assert jnp.max(jnp.abs(solution.displacement)) < 1e-15


@pytest.mark.versions
def test_second_derivatives_of_equilibrium():
    base = _ring(8 * kPa)
    tight = fem.Newton(residual_tolerance=1e-12)

    def answer(scale):
        where = (base.loads[0].value * scale[0], base.material.shear_modulus * scale[1])
        problem = eqx.tree_at(
            lambda p: (p.loads[0].value, p.material.shear_modulus), base, where
        )
        return jnp.sum(fem.solve(problem, newton=tight).displacement) * 1e3

    at, h, slope = jnp.ones(2), 1e-4, jax.grad(answer)
    hessian = jax.jacfwd(slope)(at)
    rows = [(slope(at + d) - slope(at - d)) / (2 * h) for d in h * jnp.eye(2)]
    assert jnp.allclose(hessian, hessian.T, rtol=1e-9)
    assert jnp.allclose(hessian, jnp.stack(rows), rtol=1e-6, atol=1e-6)


@pytest.mark.versions
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["now", "jit"])
def test_second_derivatives_of_the_answer_to_small_forces(wrap):
    """By modulus, state and force, against differences of the first."""
    base = _ring(8 * kPa)
    u = fem.solve(base).displacement
    draw = np.random.default_rng(0).normal(size=(2, u.size))

    def answer(scale):
        modulus = base.material.shear_modulus * scale[0]
        problem = eqx.tree_at(lambda p: p.material.shear_modulus, base, modulus)
        forces = jnp.asarray(draw[:1]) * scale[2]
        return jnp.vdot(tangent_solve(problem, u * scale[1], forces), draw[1:])

    at, h, slope = jnp.ones(3), 1e-4, wrap(jax.grad(answer))
    hessian = wrap(jax.jacfwd(jax.grad(answer)))(at)
    rows = [(slope(at + d) - slope(at - d)) / (2 * h) for d in h * jnp.eye(3)]
    scale = jnp.max(jnp.abs(hessian))
    assert jnp.allclose(hessian, hessian.T, rtol=0, atol=1e-9 * scale)
    assert jnp.allclose(hessian, jnp.stack(rows), rtol=0, atol=1e-6 * scale)
