"""The host and a trace walk the same hard paths in the same load steps and iterations."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh, sdf
from sorojax.units import mm

pytestmark = pytest.mark.quick

GRID = mesh.rectangle([0, 0], [1, 1], divisions=(8, 1), element=mesh.Quad4())


def wall(height, load, rise=0.0, poisson_ratio=0.3, formulation=None) -> fem.Problem:
    """A wall of 0.1 m of rubber that both ends hold, under the sum of three dead tractions on
    its top; with a `rise` [m] an arch."""
    x, y = np.asarray(GRID.points).T
    points = np.stack([0.1 * x, height * y + rise * np.sin(np.pi * x)], axis=1)
    nodes, top = GRID.node_sets, GRID.facet_sets["top"]
    loads = [*np.atleast_1d(load), 0.0, 0.0][:3]
    return fem.problem(
        mesh.Mesh(points, GRID.cells, GRID.element),
        material.neo_hookean(young_modulus=1e6, poisson_ratio=poisson_ratio, density=1000),
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(nodes["left"]), fem.Fixed(nodes["right"])),
        loads=tuple(
            fem.Traction(top, (0.0, -p), name=name)
            for p, name in zip(loads, "abc", strict=True)
        ),
        formulation=fem.Displacement() if formulation is None else formulation,
    )


def arch(load) -> fem.Problem:
    """One that snaps through between 1.5 and 2 kPa."""
    return wall(3 * mm, load, rise=20 * mm)


def balloon(pressure) -> fem.Problem:
    """A spherical shell of inner radius 1 m and 0.2 m thick, half of a section through its
    axis, whose pressure has a maximum."""
    grid = mesh.rectangle([1, 0], [1.2, np.pi / 2], divisions=(1, 4), element=mesh.Quad4())
    r, angle = np.asarray(grid.points).T
    points = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    points[np.asarray(grid.node_sets["top"]), 0] = 0.0
    return fem.problem(
        mesh.Mesh(points, grid.cells, grid.element),
        material.NeoHookean(1.0, 10.0),
        kinematics=fem.Axisymmetric(),
        supports=(
            fem.Fixed(grid.node_sets["bottom"], components=(1,)),
            fem.Fixed(grid.node_sets["top"], components=(0,)),
        ),
        loads=(fem.Pressure(grid.facet_sets["left"], pressure, name="air"),),
        formulation=fem.Displacement(),
    )


def block(shear=5e4) -> fem.Problem:
    """A block that a traction presses on a floor and drags along it, against soft springs;
    friction acts from the next problem on, in which it knows how hard it was pressed."""
    shape = mesh.rectangle([0, 0], [20 * mm, 5 * mm], divisions=(3, 1), element=mesh.Quad4())
    top, bottom = shape.facet_sets["top"], shape.facet_sets["bottom"]
    floor = sdf.HalfPlane([0.0, 0.0], [0.0, 1.0])
    return fem.problem(
        shape,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000),
        kinematics=fem.PlaneStrain(0.03),
        supports=(),
        loads=(
            fem.Traction(top, (shear, -1e5), name="weight"),
            fem.Foundation(shape.node_sets["top"], jnp.array([1e3, 1e-3]), name="pull"),
            fem.Contact(bottom, floor, name="floor", friction=0.5),
        ),
        formulation=fem.Displacement(),
    )


def beam() -> fem.Problem:
    """A cantilever of tetrahedra, bent and twisted far."""
    cells = mesh.box(
        [0, 0, 0], [30 * mm, 5 * mm, 10 * mm], divisions=(2, 1, 1), element=mesh.Tet4()
    )
    return fem.problem(
        cells,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3),
        kinematics=fem.Solid(),
        supports=(fem.Fixed(cells.node_sets["left"]),),
        loads=(fem.Traction(cells.facet_sets["right"], (0.0, 2e5, 1e5), name="end"),),
        formulation=fem.Displacement(),
    )


def dragged_block() -> fem.Problem:
    """A block that is dragged after it was pressed on the floor."""
    pressed = block(shear=0.0)
    pressed = fem.update_friction(pressed, fem.solve(pressed).displacement)
    return fem.with_load(pressed, "weight", jnp.array([8e4, -1e5]))


def bent(height, load):
    """Where a wall is under nearly its load [m]."""
    return fem.solve(wall(height, 0.9 * load)).displacement


# what makes the problem, whether it has an equilibrium at full load, where to start from
PATHS = {
    "thin wall bends": (lambda: wall(1 * mm, 1e4), True, None),
    "arch below its limit point": (lambda: arch(1.5e3), True, None),
    "arch snaps through": (lambda: arch(2e3), True, None),
    "arch beyond its limit point": (lambda: arch(3e3), False, None),
    "wall is crushed": (lambda: wall(50 * mm, 1e6), True, None),
    "load is out of reach": (lambda: wall(50 * mm, 1e8), False, None),
    "nearly incompressible, locked": (lambda: wall(10 * mm, 3e5, 0.0, 0.499), True, None),
    "loads cancel but for rounding": (lambda: wall(2 * mm, (1e5, 2e5, -3e5)), True, None),
    "nearly incompressible, mixed": (
        lambda: wall(10 * mm, 3e5, 0.0, 0.499, fem.ConstantPressure()), True, None,
    ),
    "start nearby": (lambda: wall(1 * mm, 1e4), True, lambda: bent(1 * mm, 1e4)),
    "start too far away": (lambda: wall(1 * mm, 1e4), True, lambda: -bent(50 * mm, 1e6)),
    "balloon below its limit point": (lambda: balloon(0.21), True, None),
    "balloon beyond its limit point": (lambda: balloon(0.3), False, None),
    "block slides on a floor": (block, True, None),
    "block is held by friction": (dragged_block, True, None),
    "beam in space": (beam, True, None),
}  # fmt: skip


def told(problem, start=None):
    found = fem.solve(problem, start=start, throw=False)
    counts = found.load_fraction, found.load_steps, found.cuts, found.iterations
    return found.displacement, found.status, jnp.stack([jnp.asarray(n, float) for n in counts])


in_trace = eqx.filter_jit(told)


@pytest.mark.parametrize("name", PATHS)
def test_a_trace_goes_the_way_of_the_host(name):
    make, found, start = PATHS[name]
    problem, start = make(), None if start is None else start()
    u, status, counts = told(problem, start)
    traced_u, traced_status, traced_counts = in_trace(problem, start)
    assert (status == Status.successful) == found == bool(counts[0] == 1.0)
    assert status == traced_status
    assert traced_counts.tolist() == counts.tolist()
    rounding = 1e-12 * jnp.max(jnp.abs(problem.mesh.points))
    largest = jnp.max(jnp.abs(u))
    assert jnp.max(jnp.abs(traced_u - u)) <= 1e-8 * largest + rounding


# Motion: the problem, the velocity of all nodes [m/s], duration and step [s], options


def thrown(problem, x=0.0, y=0.0):
    points = problem.mesh.points
    return jnp.zeros_like(points), jnp.zeros_like(points) + jnp.array([[x, y]])


def lifted(problem, x, y):
    """Two millimetres over where it is, and thrown."""
    _, speed = thrown(problem, x, y)
    return jnp.zeros_like(speed).at[:, 1].set(2 * mm), speed


MOTIONS = {
    "wall vibrates": (lambda: wall(10 * mm, 1e4), None, 4e-3, 1e-3, {}),
    "steps follow their error": (
        lambda: wall(10 * mm, 1e4), None, 1e-2, 2.5e-3, {"adaptive": 1e-2},
    ),
    "wall is crushed": (lambda: wall(50 * mm, 1e8), None, 1e-2, 1e-2, {"max_cuts": 2}),
    "block meets a floor": (
        lambda: block(shear=0.0), lambda p: lifted(p, 0.0, -5.0), 2e-3, 5e-4, {},
    ),
    "block slides on a floor": (
        lambda: block(shear=0.0), lambda p: thrown(p, 1.0), 2e-3, 5e-4, {},
    ),
    "energy is conserved": (
        lambda: wall(5 * mm, 1e4), None, 4e-3, 1e-3, {"method": fem.EnergyMomentum()},
    ),
}  # fmt: skip


def moved(problem, start, duration, step, options):
    motion = fem.simulate(problem, duration, step, start=start, throw=False, **options)
    counts = jnp.stack([motion.steps, motion.cuts])
    return motion.end.displacement, motion.status, counts


moved_in_trace = eqx.filter_jit(moved)


@pytest.mark.parametrize("name", MOTIONS)
def test_a_motion_in_a_trace_takes_the_steps_of_the_host(name):
    make, start, duration, step, options = MOTIONS[name]
    problem = make()
    start = None if start is None else start(problem)
    u, status, counts = moved(problem, start, duration, step, options)
    traced_u, traced_status, traced_counts = moved_in_trace(
        problem, start, duration, step, options
    )
    assert status == traced_status
    assert (status == Status.successful) == (name != "wall is crushed")
    assert traced_counts.tolist() == counts.tolist()
    assert jnp.max(jnp.abs(traced_u - u)) <= 1e-8 * jnp.max(jnp.abs(u))
