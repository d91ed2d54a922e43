"""Layouts at large displacement: void that folds, pressures that follow the design, objectives
with their derivatives, symmetric and passive regions."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import design, fem, material, mesh, view
from sorojax._progress import silent
from sorojax.design.density.void import InterpolatedEnergy
from sorojax.design.objectives import relax_to_minimum
from sorojax.design.optimise.mma import Approximation, solve_dual, solve_primal_dual
from sorojax.fem.equilibrium.linear import add_load_stiffness, prepare
from sorojax.fem.problem import load_force
from sorojax.material.kinematics import from_matrix
from sorojax.math.linalg import sparse
from sorojax.mesh.mesh import Mesh, boundary_facets

pytestmark = pytest.mark.quick

RUBBER = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.4)
SLOPE = np.array([[0.2, -0.3, 0.1], [0.25, -0.1, 0.05], [0.0, 0.15, 0.3]])


@jax.jit
def energies(stuff, slope):
    """Of a displacement gradient, and of its quadratic form at rest."""

    def along(t):
        return material.strain_energy_density(stuff, from_matrix(jnp.eye(3) + t * slope))

    def rate(t):
        return jax.jvp(along, (t,), (jnp.ones(()),))[1]

    return along(1.0), jax.jvp(rate, (jnp.zeros(()),), (jnp.ones(()),))[1] / 2


def test_interpolated_energy_is_the_solid_at_one_end_and_linear_at_the_other():
    whole, small = energies(InterpolatedEnergy(RUBBER, 1.0, 1.0), SLOPE)
    want, form = energies(InterpolatedEnergy(RUBBER, 2e-6, 0.0), SLOPE)
    direct = material.strain_energy_density(RUBBER, from_matrix(jnp.eye(3) + SLOPE))
    assert float(whole) == pytest.approx(float(direct), rel=1e-12)
    assert float(form) == pytest.approx(2e-6 * float(small), rel=1e-9)
    assert float(want) == pytest.approx(float(form), rel=1e-9)
    folded = jnp.diag(jnp.array([-3.0, 0.1, 0.0]))
    assert float(energies(InterpolatedEnergy(RUBBER, 1e-6, 0.0), folded)[0]) > 0
    grey = energies(InterpolatedEnergy(RUBBER, 0.5, 0.4), SLOPE)[1]
    assert float(grey) == pytest.approx(0.5 * float(small), rel=1e-9)


def test_cells_are_linear_below_the_threshold_only():
    made = design.interpolated_energy(RUBBER, jnp.array([1e-9, 1e-3, 0.01, 0.02, 1.0]))
    assert np.allclose(made.share, [0, 0, 0.5, 1, 1], atol=1e-3)
    with pytest.raises(ValueError, match="InterpolatedEnergy"):
        InterpolatedEnergy(RUBBER, 0.0, 1.0)


def part_of(grid, cells):
    """The mesh of some cells, and its nodes in the whole."""
    chosen = np.asarray(grid.cells)[cells]
    nodes, renumbered = np.unique(chosen, return_inverse=True)
    return Mesh(grid.points[nodes], renumbered.reshape(chosen.shape), grid.element), nodes


def test_void_may_fold_and_changes_nothing():
    """The C of Wang et al. 2014: its arms close on the void between them."""
    grid = mesh.rectangle([0, 0], [10.0, 10.0], divisions=(10, 10), element=mesh.Quad4())
    x, y = np.asarray(grid.points)[np.asarray(grid.cells)].mean(axis=1).T
    solid = (x < 1) | (y < 1) | (y > 9)
    stuff = material.st_venant_kirchhoff(young_modulus=1.0, poisson_ratio=0.3)
    small, nodes = part_of(grid, solid)

    def closed(body, stuff):
        tips = [mesh.nearest_node(body, [10.0, height]) for height in (0.0, 10.0)]
        loads = tuple(
            fem.Force(jnp.array([tip]), [0.0, force], name=str(tip))
            for tip, force in zip(tips, (0.004, -0.006), strict=True)
        )
        left = fem.Fixed(mesh.nodes_where(body, lambda p: p[0] <= 0))
        made = fem.problem(
            body,
            stuff,
            kinematics=fem.PlaneStrain(1.0),
            supports=(left,),
            loads=loads,
            formulation=fem.Displacement(),
        )
        with silent():
            return made, fem.solve(made, steps=2)

    _, alone = closed(small, stuff)
    factor = jnp.where(jnp.asarray(solid), 1.0, 1e-9)
    made, within = closed(grid, design.interpolated_energy(stuff, factor))
    error = np.abs(np.asarray(within.displacement)[nodes] - alone.displacement).max()
    assert error < 1e-5 * np.abs(alone.displacement).max()
    F = fem.deformation_gradient(made, within.displacement)
    assert np.min(np.linalg.det(np.asarray(F))) < 0.2


GRID = mesh.rectangle([0, 0], [12.0, 6.0], divisions=(12, 6), element=mesh.Quad4())
END = jnp.asarray(GRID.node_sets["right"])
CENTRES = np.asarray(GRID.points)[np.asarray(GRID.cells)].mean(axis=1)
HOLE = np.flatnonzero(np.abs(CENTRES - [5.0, 3.0]).max(axis=1) < 2)
TIP = jnp.array([mesh.nearest_node(GRID, [12.0, 3.0])])
KINEMATICS = fem.PlaneStrain(1.0)


def body(force=0.0, pressure=0.0):
    """A beam held at the left with an inlet in its middle and springs at its end."""
    air = design.void_pressure(GRID, jnp.zeros(72), pressure, name="air")
    return fem.problem(
        GRID,
        design.interpolated_energy(RUBBER, jnp.ones(72)),
        kinematics=KINEMATICS,
        supports=(fem.Fixed(GRID.node_sets["left"]),),
        loads=(
            fem.Force(TIP, [0.0, -force], name="push"),
            air,
            fem.Foundation(END, 1e-3, name="out"),
        ),
        formulation=fem.ConstantPressure(),
    )


@pytest.fixture(scope="module")
def plans():
    plan = design.layout(GRID, radius=1.5, solid=np.arange(2), void=np.array([70]))
    basin = design.flood(GRID, HOLE[:1], threshold=0.3)
    seep = design.darcy(
        GRID,
        body().space,
        KINEMATICS,
        sources=np.asarray(GRID.cells)[HOLE[0]],
        drains=np.asarray(GRID.facet_sets["top"]).ravel(),
        depth=2.0,
    )
    return plan, basin, seep


def start_of(plan):
    """A design with a hole in the middle."""
    grey = 0.75 + 0.1 * np.sin(np.arange(72.0))
    grey[HOLE] = 0.02
    return plan.variables(jnp.asarray(grey))


def designed(plans, x, force, pressure, chamber):
    plan, basin, seep = plans
    density = plan(x, 4.0)
    made = design.graded(body(force, pressure), design.Simp(3.0, 1e-6)(density))
    if chamber == "flood":
        share = design.void_pressure(GRID, basin(density), pressure, name="air")
        made = design.replaced_load(made, share)
    if chamber == "darcy":
        share = design.void_pressure(GRID, seep(density), pressure, per="node", name="air")
        made = design.replaced_load(made, share)
    return made


TIGHT = fem.Newton(residual_tolerance=1e-12, step_tolerance=1e-9)


def solved(made):
    return fem.solve(made, newton=TIGHT).displacement


def stiff(plans, x):
    made = designed(plans, x, 3e-3, 0.0, None)
    return design.work_of_loads(made, solved(made))


def gripping(plans, x):
    made = designed(plans, x, 3e-3, 0.0, None)
    u = solved(made)
    out = design.displacement_along(u, END, [1.0, 0.0])
    return design.mechanism(made, u, out, output_weight=2.0, work_weight=0.5)


def turning(plans, x, chamber):
    made = designed(plans, x, 0.0, 0.02, chamber)
    return design.rotation(made, solved(made), END)


def following(plans, x):
    made = designed(plans, x, 3e-3, 0.0, None)
    row = jnp.array([[0.0, -1e-3], [0.0, -3e-3]])
    path = fem.solve_path(made, newton=TIGHT, push=row)
    return design.path_error(path, TIP, jnp.array([[12.0, 2.9], [11.9, 2.6]]))


OBJECTIVES = {
    "compliance": stiff,
    "mechanism": gripping,
    "path": following,
    "flood": lambda plans, x: turning(plans, x, "flood"),
    "darcy": lambda plans, x: turning(plans, x, "darcy"),
}


@pytest.mark.parametrize("name", OBJECTIVES)
def test_density_gradients_agree_with_differences(plans, name):
    objective = OBJECTIVES[name]
    x = start_of(plans[0])
    way = jnp.asarray(np.random.default_rng(3).standard_normal(x.size))
    slope = float(jnp.vdot(jax.grad(lambda x: objective(plans, x))(x), way))
    h = 1e-5
    ahead, behind = (float(objective(plans, x + s * h * way)) for s in (1, -1))
    assert slope == pytest.approx((ahead - behind) / (2 * h), rel=1e-5)
    assert abs(slope) > 1e-6


def test_a_pressure_in_void_is_that_on_the_walls_of_a_cavity():
    """Cells without stiffness under pressure push on what surrounds them as a gas does."""
    inside = np.zeros(72, bool)
    inside[HOLE] = True
    factor = jnp.where(jnp.asarray(inside), 1e-9, 1.0)
    made = design.graded(body(), factor)
    share = design.void_pressure(GRID, jnp.asarray(inside, float), 0.05, name="air")
    within = fem.solve(design.replaced_load(made, share)).displacement

    small, nodes = part_of(GRID, ~inside)
    facets = boundary_facets(small)
    middle = np.asarray(small.points)[facets].mean(axis=1)
    walls = facets[np.abs(middle - [5.0, 3.0]).max(axis=1) < 2.1]
    place = {n: k for k, n in enumerate(nodes)}
    end = jnp.array([place[n] for n in END.tolist()])
    alone = fem.problem(
        small,
        RUBBER,
        kinematics=KINEMATICS,
        supports=(fem.Fixed(mesh.nodes_where(small, lambda p: p[0] <= 0)),),
        loads=(fem.Pressure(walls, 0.05, name="air"), fem.Foundation(end, 1e-3)),
        formulation=fem.ConstantPressure(),
    )
    u = fem.solve(alone).displacement
    assert np.abs(u).max() > 0.05
    assert np.allclose(np.asarray(within)[nodes], u, atol=1e-6 * np.abs(u).max())


@pytest.mark.parametrize(
    ("element", "kinematics"),
    [
        (mesh.Tri6(), fem.PlaneStrain(2.0)),
        (mesh.Quad4(), fem.Axisymmetric()),
        (mesh.Hex8(), fem.Solid()),
    ],
)
def test_the_stiffness_of_a_pressure_in_void(element, kinematics):
    """Against differences of its force, in every kinematics."""
    if element.dim == 2:
        grid = mesh.rectangle([1.0, 0], [3.0, 1.0], divisions=(2, 1), element=element)
    else:
        grid = mesh.box([0.0] * 3, [2.0, 1.0, 1.0], divisions=(2, 1, 1), element=element)
    share = jnp.linspace(0.2, 1.0, grid.num_nodes)
    load = design.void_pressure(grid, share, 0.3, per="node", name="air")
    made = fem.problem(
        grid,
        RUBBER,
        kinematics=kinematics,
        supports=(),
        loads=(load,),
        free=True,
        formulation=fem.Displacement(),
    )
    u = 0.1 * jnp.sin(3 * grid.points)
    way = jnp.cos(2 * grid.points)
    system, none = made.space.system, jnp.zeros(made.space.system.num_values)
    prepared = prepare(made)

    @jax.jit
    def stiffness(u):
        values = add_load_stiffness(made, prepared, u, none)
        return sparse.product(system, values, way.ravel())

    h = 1e-5
    ahead, behind = (-load_force(made, u + s * h * way).ravel() for s in (1, -1))
    want = (ahead - behind) / (2 * h)
    assert np.allclose(stiffness(u), want, atol=1e-8) and np.abs(want).max() > 1e-2


def test_flood_fills_what_the_source_reaches(plans):
    _, basin, _ = plans
    density = np.ones(72)
    density[HOLE] = 0.0
    apart = np.flatnonzero(CENTRES[:, 0] > 11)
    density[apart] = 0.0
    wet = np.asarray(eqx.filter_jit(basin)(jnp.asarray(density)))
    assert np.array_equal(np.flatnonzero(wet == 1), np.sort(HOLE)) and wet.sum() == len(HOLE)
    closed = np.asarray(basin(jnp.ones(72)))
    assert np.array_equal(np.flatnonzero(closed), HOLE[:1])
    with pytest.raises(ValueError, match="flood: got sources"):
        design.flood(GRID, [72])


def test_darcy_is_full_in_void_and_gone_behind_a_wall(plans):
    """In a thick wall the share falls exponentially, to a tenth within the depth."""
    strip = mesh.rectangle([0, 0], [40.0, 1.0], divisions=(160, 1), element=mesh.Quad4())
    seep = design.darcy(
        strip,
        fem.space(strip),
        KINEMATICS,
        sources=strip.node_sets["left"],
        depth=2.0,
        drains=strip.node_sets["right"],
    )
    x = np.asarray(strip.points)[:, 0]
    middle = x[np.asarray(strip.cells)].mean(axis=1)
    share = np.asarray(seep(jnp.asarray(np.where(middle < 20, 0.0, 1.0))))
    assert np.all(share[x <= 20] > 1 - 1e-4)
    wall = (x >= 20) & (x < 30)
    assert np.allclose(share[wall], 10 ** (-(x[wall] - 20) / 2), atol=2e-3)
    with pytest.raises(ValueError, match="darcy: got 2 sources"):
        design.darcy(strip, fem.space(strip), KINEMATICS, sources=[0, 1], drains=[1], depth=1.0)


def test_layouts_are_symmetric_and_keep_their_passive_cells():
    """Two strips, each symmetric: a quarter of the cells decide."""
    rules = (design.Repeated(0, 6.0), design.Mirrored(0, 3.0))
    solid, void = np.flatnonzero(CENTRES[:, 1] < 1), np.array([40])
    plan = design.layout(GRID, radius=1.2, symmetries=rules, solid=solid, void=void)
    assert plan.num_variables == 18
    x = jnp.asarray(np.random.default_rng(0).uniform(size=18))
    whole = design.layout(GRID, symmetries=rules)(x)
    grid = np.full((12, 6), np.nan)
    grid[CENTRES[:, 0].astype(int), CENTRES[:, 1].astype(int)] = whole
    assert np.array_equal(grid[:6], grid[6:]) and np.array_equal(grid, grid[::-1])
    density = plan(x, 8.0)
    assert np.all(density[solid] == 1) and float(density[40]) == 0
    assert float(plan.volume_fraction(density)) == pytest.approx(float(jnp.mean(density)))
    gradient = jax.grad(lambda x: plan.volume_fraction(plan(x, 8.0)))(x)
    assert np.all(np.isfinite(gradient)) and np.any(gradient > 0)
    back = plan.variables(whole)
    assert np.allclose(back, x)
    with pytest.raises(ValueError, match="has its counterpart"):
        design.layout(GRID, symmetries=(design.Mirrored(0, 3.2),))
    with pytest.raises(ValueError, match=r"is in `solid` and in `void`"):
        design.layout(GRID, solid=[3], void=[3])


@pytest.mark.parametrize("make", [design.cone_filter, design.helmholtz_filter])
def test_a_periodic_filter_knows_no_ends(make):
    """What is moved along comes out moved along, across the ends too."""
    smooth = make(GRID, 1.5, periods=(12.0, None))
    place = CENTRES[:, 0].astype(int) + 12 * CENTRES[:, 1].astype(int)
    density = np.random.default_rng(0).uniform(size=(6, 12))

    def smoothed(rows):
        out = np.empty(72)
        out[place] = smooth(jnp.asarray(rows.ravel()[place]))
        return out.reshape(6, 12)

    whole = smoothed(density)
    for shift in (1, 5):
        assert np.allclose(smoothed(np.roll(density, shift, 1)), np.roll(whole, shift, 1))
    assert np.allclose(smoothed(np.full((6, 12), 0.3)), 0.3, rtol=1e-12)
    assert not np.allclose(smoothed(np.roll(density, 1, 0)), np.roll(whole, 1, 0), atol=1e-2)
    with pytest.raises(ValueError, match=f"{make.__name__}: got periods"):
        make(GRID, 1.5, periods=(6.0, None))


def test_a_helmholtz_filter_repeats_meshes_whose_ends_match():
    both = design.helmholtz_filter(GRID, 1.5, periods=(12.0, 6.0))
    assert both.system.size == 72
    with pytest.raises(ValueError, match="do not repeat after 13 m along axis 0"):
        design.helmholtz_filter(GRID, 1.5, periods=(13.0, None))
    row = mesh.rectangle([0, 0], [1.0, 3.0], divisions=(1, 3), element=mesh.Quad4())
    with pytest.raises(ValueError, match="at least two cells"):
        design.helmholtz_filter(row, 1.5, periods=(1.0, None))


@pytest.mark.parametrize("right", [0.5, 3.0, -2.0])
def test_one_constraint_by_its_multiplier_is_the_interior_point_answer(right):
    """Active, idle, and impossible, where breaking it has its price."""
    random = np.random.default_rng(1)
    p, q = (jnp.asarray(random.uniform(1e-3, 1.0, (2, 30))) for _ in range(2))
    one = jnp.ones(30)
    task = Approximation(
        p, q.at[1].set(1e-3), -one, 2 * one, 0 * one, one, 10 * jnp.array([right]), jnp.zeros(1)
    )
    dual, interior = jax.jit(solve_dual)(task), jax.jit(solve_primal_dual)(task)
    # the interior point stays a little away from its bounds
    assert np.allclose(dual, interior, atol=1e-4)
    assert task.at(dual)[0] <= task.at(interior)[0] + 1e-4 * abs(task.at(interior)[0])


def test_a_follower_starts_from_the_last_design_and_history_keeps_the_designs():
    made = body(1e-3)
    follow = design.Follower()
    plan = design.layout(GRID, radius=1.5)
    history = design.History(lambda step: plan(step.design), every=2, mesh=GRID)

    def loss(x):
        graded = design.graded(made, design.Simp(3.0, 1e-6)(plan(x)))
        return design.work_of_loads(graded, follow(graded).displacement)

    with silent():
        found = design.minimise(
            loss,
            jnp.full(72, 0.5),
            constraints=(lambda x: jnp.mean(plan(x)) - 0.5,),
            steps=4,
            on_step=history,
        )
    assert np.all(np.diff(found.history["objective"]) < 0)
    assert history.densities.shape == (2, 72) and history.steps == [1, 3]
    assert len(view.show(history).panels) == 2
    film = list(view.animate(history, fps=2.0, speed=1.0, size=(160, 120), stamp=False))
    assert len(film) >= 2 and np.any(np.asarray(film[0]) != np.asarray(film[-1]))
    with pytest.raises(ValueError, match="got no mesh"):
        view.show(design.History(lambda step: step.design))
    again = eqx.filter_jit(lambda x: plan(x))(found.design)
    fresh = fem.solve(design.graded(made, design.Simp(3.0, 1e-6)(again)))
    assert follow.last is not None and np.allclose(follow.last, fresh.displacement, atol=1e-8)


def arch(force):
    """A shallow arch of the cells of `GRID`, pushed down in its middle."""
    x, y = GRID.points.T
    points = jnp.stack([x, 0.08 * (y - 3) + jnp.sin(jnp.pi * x / 12)], axis=1)
    top = jnp.array([mesh.nearest_node(GRID, [6.0, 6.0])])
    held = tuple(fem.Fixed(GRID.node_sets[side]) for side in ("left", "right"))
    made = eqx.tree_at(lambda p: p.mesh.points, body(force), points)
    made = eqx.tree_at(lambda p: p.loads[0].nodes, made, top)
    return dataclasses.replace(made, supports=held), int(top[0])


def test_a_body_that_has_buckled_falls_into_a_stable_state():
    """Newton's method along the load jumps over the snap; downhill is the same state."""
    made, top = arch(5e-3)
    want = fem.solve(made, steps=4).displacement
    assert float(want[top, 1]) < -1.5
    before = fem.solve(arch(2e-3)[0]).displacement
    u, stable = relax_to_minimum(made, before)
    assert stable and np.allclose(u, want, atol=1e-5)
    follow = design.Follower(newton=fem.Newton(max_iterations=4), max_cuts=0)
    follow.last = np.asarray(before)
    assert np.allclose(follow(made).displacement, want, atol=1e-7)
    assert not relax_to_minimum(made, before, steps=2)[1]
