"""Loads and supports as terms: springs, tendons, torques, rigid parts, turned nodes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, io, material, mesh
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.loads.facets import CurvedPart, group_matrices, open_nodes
from sorojax.fem.problem import load_force
from sorojax.math.linalg import sparse
from sorojax.units import mm

pytestmark = pytest.mark.quick

RUBBER = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3)
BEAM = mesh.rectangle([0, 0], [60 * mm, 10 * mm], divisions=(6, 2), element=mesh.Quad8())
CUBE = mesh.box([0, 0, 0], [20 * mm, 20 * mm, 20 * mm], divisions=(2, 1, 1))
LEFT, RIGHT = (np.asarray(BEAM.node_sets[side]) for side in ("left", "right"))
WAY = np.array([[1, 8], [20, 8], [24, 7], [59, 7]]) * mm


def _problem(*loads, grid=BEAM, supports=None, **more):
    return fem.problem(
        grid,
        RUBBER,
        kinematics=fem.PlaneStrain(10 * mm) if grid.element.dim == 2 else None,
        supports=(fem.Fixed(grid.node_sets["left"]),) if supports is None else supports,
        loads=loads,
        formulation=fem.Displacement(),
        **more,
    )


def _terms(grid):
    """One of every term that has a stiffness of its own."""
    dim, right = grid.element.dim, np.asarray(grid.node_sets["right"])
    left = np.asarray(grid.node_sets["left"])[: len(right)]
    points = WAY if dim == 2 else np.array([[1, 8, 3], [11, 8, 4], [19, 9, 6]]) * mm
    way = fem.route(grid, points)
    return (
        fem.Spring(right[:1], np.full(dim, -5 * mm), 50.0, 5 * mm, name="ground"),
        fem.Spring(right, left[::-1], np.linspace(10.0, 20.0, len(right)), name="pairs"),
        fem.Foundation(right, np.arange(1.0, dim + 1), np.full(dim, 1 * mm)),
        fem.Torque(right, 1e-2, None if dim == 2 else [1.0, 0.3, 0.0]),
        fem.Tendon(way, 2.0),
        fem.Cable(way, 500.0, 2 * mm),
        fem.Force(right, np.zeros(dim)),
        fem.rigid(grid, right, stiffness=1e3),
    )


ALL = _problem(*_terms(BEAM))


def _only(**terms):
    """The beam with all terms switched off but those named, whose fields may be given, so
    that all tests share their kernels."""
    problem = ALL
    for k, load in enumerate(ALL.loads):
        for field in ("value", "stiffness"):
            if hasattr(load, field):
                given = terms[load.name].get(field) if load.name in terms else 0.0
                old = getattr(load, field)
                new = old if given is None else jnp.full(old.shape, given, old.dtype)
                problem = eqx.tree_at(
                    lambda p, k=k, field=field: getattr(p.loads[k], field), problem, new
                )
    return problem


def test_the_ends_of_springs_are_integers_of_any_length():
    left, right = (np.asarray(BEAM.node_sets[side]) for side in ("left", "right"))
    found = []
    for kind in (np.int32, np.int64):
        pairs = fem.Spring(right, left[: len(right)].astype(kind), 50.0, 5 * mm)
        problem = _problem(pairs)
        found.append(np.asarray(fem.solve(problem).displacement))
    assert np.array_equal(*found) and np.abs(found[0]).max() > 0


def _load(problem, name):
    return next(load for load in problem.loads if load.name == name)


def test_tangent_of_every_term_is_the_slope_of_its_force(getkey):
    u = 3e-4 * jax.random.normal(getkey(), BEAM.points.shape)
    way = jax.random.normal(getkey(), u.shape)
    values = linearise(ALL, prepare(ALL), u, u).values
    product = sparse.product(ALL.space.system, values, way.ravel())
    change = jax.jvp(lambda u: fem.residual(ALL, u), (u,), (way,))[1].ravel()
    assert jnp.max(jnp.abs(product - change)) < 1e-11 * jnp.max(jnp.abs(change))


def test_stiffness_of_every_term_in_space(getkey):
    """As above, of the loads alone."""
    problem = _problem(*_terms(CUBE), grid=CUBE)
    u = 3e-4 * jax.random.normal(getkey(), CUBE.points.shape)
    way = jax.random.normal(getkey(), u.shape)
    slots = prepare(problem).group_slots

    @jax.jit
    def both(u):
        system, x = problem.space.system, problem.mesh.points + u
        parts = [part for load in problem.loads if (part := load.curved_part(problem))]
        values = jnp.zeros(system.num_values)
        for part, at in zip(parts, slots, strict=True):
            values = values.at[at].add(group_matrices(part, x[part.groups]))
        slope = jax.jvp(lambda u: -load_force(problem, u), (u,), (way,))[1]
        return sparse.product(system, values, way.ravel()), slope.ravel()

    product, change = both(u)
    assert jnp.max(jnp.abs(product - change)) < 1e-11 * jnp.max(jnp.abs(change))


def test_a_node_that_stands_twice_in_a_group_counts_fully(getkey):
    """The sum of the entries of a group is that of the energy in the distinct nodes."""
    x = jax.random.normal(getkey(), (2, 2))

    def energy(x, _):
        return jnp.sum(jnp.sin(x[0]) * x[1] ** 2 * x[2])

    part = CurvedPart(jnp.array([[0, 1, 0]]), energy)
    upper = group_matrices(part, x[part.groups])
    pattern = sparse.from_cells(2, np.array([[0, 1]]), 2)
    slots = sparse.slots_of(pattern, np.array([[0, 1, 2, 3, 0, 1]]))
    values = jnp.zeros(pattern.num_values).at[slots].add(upper)
    matrix = jnp.zeros((4, 4)).at[pattern.rows, pattern.cols].set(values)
    whole = jax.jit(jax.hessian(lambda flat: energy(flat.reshape(2, 2)[part.groups[0]], None)))
    exact = whole(x.ravel())
    assert jnp.allclose(matrix, jnp.triu(exact), atol=1e-13)


def test_a_tendon_pulls_with_its_tension_and_a_stiff_cable_keeps_its_length():
    tendon = _load(ALL, "tendon")
    force = -jax.grad(lambda u: tendon.potential(ALL, u))(0.0 * BEAM.points)
    assert jnp.max(jnp.abs(jnp.sum(force, axis=0))) < 1e-12
    # virtual work: 2 N times the shortening, for a stretch of the body along x
    stretch = jnp.stack([BEAM.points[:, 0], jnp.zeros(BEAM.num_nodes)], axis=1)
    lean = np.diff(WAY, axis=0)
    rate = (lean[:, 0] ** 2 / np.linalg.norm(lean, axis=1)).sum()
    assert jnp.allclose(-jnp.sum(force * stretch), 2.0 * rate, rtol=1e-10)
    pulled = _only(cable={"value": 2 * mm, "stiffness": 1e6})
    u = fem.solve(pulled).displacement
    rest, length = (fem.tendon_length(BEAM, move, tendon.route) for move in (0.0 * u, u))
    tension = fem.tension(pulled, u, "cable")
    assert jnp.allclose(rest - length, 2 * mm - tension / 1e6, rtol=1e-9)
    same = fem.solve(_only(tendon={"value": tension})).displacement
    assert jnp.max(jnp.abs(same - u)) < 1e-7 * jnp.max(jnp.abs(u))
    assert jnp.min(u[RIGHT, 1]) > 1 * mm


def test_a_slack_cable_does_nothing():
    u = fem.solve(_only(cable={"value": -1 * mm, "stiffness": 100.0})).displacement
    assert jnp.max(jnp.abs(u)) < 1e-14


def test_springs_obey_their_law_and_hold_a_body():
    problem = _only(ground={})
    u = fem.solve(problem).displacement
    start, end = BEAM.points[RIGHT[0]], jnp.full(2, -5 * mm)
    longer = jnp.linalg.norm(start + u[RIGHT[0]] - end) - jnp.linalg.norm(start - end) + 5 * mm
    reaction = fem.reaction_force(problem, u, jnp.asarray(LEFT))
    assert jnp.allclose(jnp.linalg.norm(reaction), 50.0 * longer, rtol=1e-7)
    assert jnp.allclose(fem.tension(problem, u, "ground"), 50.0 * longer, rtol=1e-12)
    problem = _only(foundation={})
    u = fem.solve(problem).displacement
    ground = jnp.array([1.0, 2.0]) * jnp.sum(1 * mm - u[RIGHT], axis=0)
    reaction = fem.reaction_force(problem, u, jnp.asarray(LEFT))
    assert jnp.allclose(-reaction, ground, rtol=1e-7)
    corners, pull = np.asarray(BEAM.node_sets["corners"]), fem.Force(RIGHT, np.ones(2))
    _problem(fem.Foundation(corners, 2.0), pull, supports=())
    with pytest.raises(ValueError, match="3 rigid-body mode"):
        _problem(pull, supports=())


def test_a_torque_bends_a_beam_and_has_no_force():
    problem = _only(torque={"value": 2e-3})
    u = fem.solve(problem).displacement
    reaction = fem.residual(problem, u)[LEFT]
    assert jnp.max(jnp.abs(jnp.sum(reaction, axis=0))) < 1e-8
    arm = (BEAM.points + u)[LEFT]
    moment = jnp.sum(arm[:, 0] * reaction[:, 1] - arm[:, 1] * reaction[:, 0])
    assert jnp.allclose(moment, -2e-3, rtol=1e-7)
    turned = fem.mean_rotation(BEAM.points[RIGHT], (BEAM.points + u)[RIGHT])
    stiffness = 1e5 / (1 - 0.3**2) * 10 * mm * (10 * mm) ** 3 / 12
    assert jnp.allclose(turned, 2e-3 * 60 * mm / stiffness, rtol=0.02)


def test_a_rigid_part_keeps_its_shape_and_turns_freely():
    turned = fem.rotated(CUBE.points, 1.2, jnp.zeros(3), jnp.array([1.0, 1.0, 0.0]))
    solid = _problem(fem.rigid(CUBE, CUBE.node_sets["right"]), grid=CUBE)
    assert solid.loads[0].potential(solid, turned) < 1e-20 * solid.loads[0].stiffness
    grown = fem.with_load(solid, "rigid", 0.02)
    swollen = turned + 0.02 * (CUBE.points + turned)
    assert grown.loads[0].potential(grown, swollen) < 1e-20 * solid.loads[0].stiffness
    stiff = _problem(fem.rigid(BEAM, RIGHT)).loads[0].stiffness
    free, tied = (
        _only(ground={"stiffness": 4.0}, rigid={"stiffness": s}) for s in (0.0, stiff)
    )

    def change(problem):
        u, X = fem.solve(problem).displacement[RIGHT], np.asarray(BEAM.points[RIGHT])
        x = X + np.asarray(u)
        far, before = (np.linalg.norm(p[:, None] - p[None], axis=2) for p in (x, X))
        return np.abs(far - before).max() / np.abs(u).max(), np.abs(u).max()

    assert change(free)[0] > 4e-3
    assert change(tied)[0] < 2e-3 and change(tied)[1] > 1e-4


def test_turned_nodes_follow_the_arc_and_carry_gradients():
    about = jnp.array([30 * mm, 5 * mm])
    grid = mesh.rectangle([0, 0], [60 * mm, 10 * mm], divisions=(3, 1), element=mesh.Quad4())
    left, right = (np.asarray(grid.node_sets[side]) for side in ("left", "right"))
    points = grid.points[right]
    move = fem.rotated(points, jnp.pi / 2, about)
    assert jnp.allclose(move[:, 0] + points[:, 0] - about[0], -(points[:, 1] - about[1]))

    def work(angle):
        turned = fem.Rotated(right, points, angle, points.mean(axis=0))
        problem = _problem(grid=grid, supports=(fem.Fixed(left), turned))
        return fem.potential_energy(problem, fem.solve(problem).displacement)

    angle, h = jnp.array(1.0), 1e-4
    slope = (work(angle + h) - work(angle - h)) / (2 * h)
    assert jnp.allclose(jax.grad(work)(angle), slope, rtol=1e-5)


def test_pressure_between_two_planes_that_miss_the_origin_has_a_potential():
    """The ends of the loaded side slide on y = 1 and y = 3: the stress is minus the pressure,
    wherever the origin is, in the few steps of an exact tangent."""
    grid = mesh.rectangle([0, 1], [1, 3], divisions=(2, 3), element=mesh.Quad4())
    walls = grid.node_sets
    slide = tuple(fem.Fixed(walls[name], components=(1,)) for name in ("bottom", "top"))
    pushed = fem.Pressure(grid.facet_sets["right"], 0.3 * RUBBER.shear_modulus)
    arguments = {"kinematics": fem.PlaneStrain(1.0), "formulation": fem.Displacement()}
    problem = fem.problem(
        grid,
        RUBBER,
        supports=(*slide, fem.Fixed(walls["left"], components=(0,))),
        loads=(pushed,),
        **arguments,
    )
    solution = fem.solve(problem, newton=fem.Newton(residual_tolerance=1e-12))
    stress = fem.cauchy_stress(problem, solution.displacement)[..., 0, 0]
    assert jnp.allclose(stress, -pushed.value, rtol=1e-10)
    assert solution.stats.iterations <= 6
    with pytest.raises(ValueError, match="depends on the way"):
        fem.problem(
            grid,
            RUBBER,
            supports=(slide[0], fem.Fixed(walls["left"])),
            loads=(pushed,),
            **arguments,
        )


@pytest.mark.parametrize("element", [mesh.Quad8(), mesh.Tri6(), mesh.Hex8()])
def test_recovered_fields_have_the_order_of_the_element(element):
    """A polynomial of the order of the element is recovered exactly, on the boundary too."""
    if element.dim == 2:
        grid = mesh.rectangle([0, 0], [1, 1], divisions=(3, 3), element=element)
    else:
        grid = mesh.box([0, 0, 0], [1, 1, 1], divisions=(2, 2, 2), element=element)

    def field(p):
        linear = 1 + p[..., 0] - 2 * p[..., 1]
        return linear + (p[..., 0] * p[..., 1] if element.order == 2 else 0.0)

    fit = fem.patches(grid)
    found = fit(field(fem.sample_points(grid)))
    assert jnp.max(jnp.abs(found - field(grid.points))) < 1e-10
    assert jnp.allclose(jnp.sum(fit.weights, axis=1), 1.0, rtol=1e-10)


@pytest.mark.parametrize("element", [mesh.Quad4(), mesh.Quad9(), mesh.Tri6()])
def test_recovered_stress_beats_the_average(element):
    """Bending by a manufactured displacement, against its own stress: of quadratic cells
    inside. Of linear ones it is the average."""

    def exact(p):
        return jnp.stack([0.3 * p[..., 0] ** 2 * p[..., 1], 0.2 * p[..., 1] ** 3], axis=-1)

    n = 8 // element.order
    grid = mesh.rectangle([0, 0], [1, 1], divisions=(n, n), element=element)
    problem = _problem(grid=grid)
    u = exact(grid.points)

    @jax.jit
    @jax.vmap
    def sigma(p):
        F = jnp.eye(3).at[:2, :2].add(jax.jacfwd(exact)(p))
        return material.cauchy_stress(RUBBER, F)

    want = sigma(grid.points)[:, 0, 0]
    averaged = fem.nodal_average(problem, fem.cauchy_stress(problem, u)[..., 0, 0])
    found = fem.nodal_stress(problem, u)[:, 0, 0]
    edge = jnp.any((grid.points < 0.01) | (grid.points > 0.99), axis=1)
    recovered, plain = (jnp.sqrt(jnp.mean((f - want)[~edge] ** 2)) for f in (found, averaged))
    if element.order == 1:
        assert jnp.allclose(found, averaged, rtol=1e-10)
    else:
        assert recovered < 0.5 * plain
    total = jnp.sum(fem.strain_energy(problem, u))
    assert jnp.allclose(total, fem.potential_energy(problem, u), rtol=1e-12)


def test_results_go_to_vtu_and_pvd(tmp_path):
    problem = _only(force={})
    path = fem.solve_path(problem, force=jnp.array([[0.0, 1e-3], [0.0, 2e-3]]))
    files = io.export_fields(
        "run.pvd", problem, path, fields=io.fields.FIELDS, times=[0.5, 1.0], root=tmp_path
    )
    assert [file.name for file in files] == ["run_0000.vtu", "run_0001.vtu", "run.pvd"]
    assert 'timestep="0.5"' in files[-1].read_text()
    import meshio

    read = meshio.read(files[1])
    assert read.cells[0].type == "quad8" and np.array_equal(read.cells[0].data, BEAM.cells)
    u = path.displacements[1]
    assert np.allclose(read.point_data["displacement"][:, :2], u)
    energy = np.asarray(fem.strain_energy(problem, u))
    assert np.allclose(read.cell_data["energy"][0], energy)
    io.export_fields(tmp_path / "last.vtu", problem, path, deformed=True, unit=mm)
    moved = meshio.read(tmp_path / "last.vtu").points[:, :2] * mm
    assert np.allclose(moved, BEAM.points + u) and len(list(tmp_path.iterdir())) == 4
    with pytest.raises(ValueError, match="leads to"):
        io.export_fields("../run.vtu", problem, path, root=tmp_path)
    with pytest.raises(ValueError, match="got fields"):
        io.export_fields(tmp_path / "a.vtu", problem, path, fields=("colour",))


_HERE = np.array([0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fem.Spring(_HERE, np.array([1]), -1.0), "stiffness.*must be positive"),
        (lambda: fem.Spring(_HERE, np.array([99]), 1.0), "ends.*names nodes 99"),
        (lambda: fem.Spring(_HERE, np.zeros(2), 1.0), "ends at the same place"),
        (lambda: fem.Spring(_HERE, np.ones(3), 1.0), "`ends` of shape"),
        (lambda: fem.Spring(_HERE, np.ones(2), np.ones(4)), "stiffness of shape"),
        (lambda: fem.Foundation(_HERE, -1.0), "at least 0"),
        (lambda: fem.Foundation(_HERE, np.nan), "at least 0"),
        (lambda: fem.Foundation(np.array([], int), 1.0), "acts on no node"),
        (lambda: fem.Torque(RIGHT, 1.0, [0.0, 0.0, 1.0]), "none in the plane"),
        (lambda: fem.Torque(_HERE, 1.0), "cannot turn"),
        (lambda: fem.Force(np.array([-1]), np.zeros(2)), "names nodes -1"),
        (lambda: fem.Force(_HERE, np.array([np.nan, 0.0])), "must be finite"),
        (lambda: fem.Force(_HERE, 1.0), "value of shape"),
        (lambda: fem.Tendon(fem.route(BEAM, WAY), np.inf), "must be finite"),
        (lambda: fem.Cable(fem.route(BEAM, WAY), -5.0), "must be positive"),
        (lambda: fem.route(BEAM, np.array([[1.0, 1.0], [2.0, 2.0]])), "outside the mesh"),
        (lambda: fem.route(BEAM, WAY[[0, 0]]), "are the same"),
        (lambda: fem.route(BEAM, WAY[:1]), "at least two"),
        (lambda: fem.rigid(BEAM, np.array([0, 999])), "got numbers 0 to 999 in `nodes`"),
    ],
)
def test_bad_terms_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        _problem(make())


def test_bad_supports_and_spaces_are_refused():
    with pytest.raises(ValueError, match="must be finite"):
        _problem(supports=(fem.Prescribed(LEFT, np.array([np.nan, 0.0])),))
    with pytest.raises(ValueError, match="no room for Torque"):
        fem.problem(
            BEAM,
            RUBBER,
            kinematics=fem.PlaneStrain(1.0),
            supports=(fem.Fixed(LEFT),),
            loads=(fem.Torque(RIGHT, 1.0),),
            space=fem.space(BEAM),
        )


@pytest.mark.parametrize("element", [mesh.Tet4(), mesh.Tet10(), mesh.Hex8()])
def test_the_rim_of_a_set_of_facets_is_found_with_its_middles(element):
    cube = mesh.box([0, 0, 0], [1, 1, 1], divisions=(2, 2, 2), element=element)
    found = open_nodes(element, cube.facet_sets["right"])
    points = np.asarray(cube.points)[found]
    assert np.all(points[:, 0] == 1)
    assert np.all(np.isclose(np.abs(points[:, 1:] - 0.5).max(axis=1), 0.5))
    assert len(found) == (16 if element.order == 2 else 8)
