"""Slopes of what stands between a design and its worth."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax import Status, design, fem, material, mesh
from sorojax.design import pneunet
from sorojax.design.calibration.calibration import sensitivity
from sorojax.fem.equilibrium.solve import Path
from tests.derivatives.case import Case
from tests.derivatives.fem import SHARP, drawn, uneven

NONE = {
    "loops on the host, whose answers have no derivative": (
        "minimise minimise_shape optimise_pneunet calibrate relax_to_minimum"
    ),
    "reports on a fit, on the host": "validate unidentifiable",
    "a whole chain, compared by tests/test_closed_loop.py": "drawing_to_loop",
    "shapes and meshes of finished densities, on the host": "part reanalyse",
}

GRID = uneven(mesh.rectangle([0, 0], [1.2, 0.8], divisions=(3, 2), element=mesh.Quad4()))
LEFT, RIGHT = GRID.node_sets["left"], GRID.node_sets["right"]
RUBBER = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.4)
PULL = fem.Force(RIGHT, [0.02, 0.01])
#: From void to solid, both bounds included.
DENSITY = jnp.asarray([1.0, 0.0, 0.8, 0.3, 1.0, 0.6])
SIMP = design.Simp(3.0, 1e-3)


def body(*loads, rubber=RUBBER):
    return fem.problem(
        GRID,
        rubber,
        kinematics=fem.PlaneStrain(0.7),
        supports=(fem.Fixed(LEFT),),
        loads=loads or (PULL,),
    )


def of_density(verb, *more, **options):
    """`verb(density, *more)`, its numbers varied too."""
    options = {"forward": False, "step": 1e-4} | options
    return Case(lambda at: verb(*at), (DENSITY, *more), **options)


# ---- from variables to densities


def through(make):
    """What `make` makes is called with densities."""
    return lambda: Case(lambda at: at[0](at[1]), (make(), DENSITY), forward=False, step=1e-4)


def planned():
    mirrored = design.layout(
        mesh.rectangle([0, 0], [1.2, 0.8], divisions=(3, 2), element=mesh.Quad4()),
        radius=0.5,
        solid=[0],
        void=[5],
        symmetries=(design.Mirrored(0, 0.6),),
    )
    numbers = jnp.asarray([0.0, 1.0, 0.3, 0.7]), jnp.asarray(4.0)
    return Case(lambda at: at[0](*at[1:]), (mirrored, *numbers), forward=False, step=1e-4)


def seeping(density, points, depth, settings):
    cells, made = eqx.tree_at(lambda m: m.points, GRID, points), body()
    found = design.darcy(
        cells, made.space, made.kinematics, sources=LEFT, drains=RIGHT, depth=depth, **settings
    )
    return found(density)


SEEPS = {"threshold": 0.3, "sharpness": 6.0, "tight": 0.01, "remainder": 0.1}


CASES = {
    "propagate_covariance": Case(
        lambda at: design.propagate_covariance(
            lambda x: jnp.sin(x[0]) * x[1] ** 2, at[0], covariance=at[1] @ at[1].T, order=2
        ),
        (jnp.array([0.7, 1.3]), jnp.array([[0.2, 0.0], [0.1, 0.3]])),
    ),
    "cone_filter": through(lambda: design.cone_filter(GRID, 0.6)),
    "factor of Simp": through(lambda: SIMP),
    "factor of Ramp": through(lambda: design.Ramp(8.0, 1e-3)),
    "helmholtz_filter": through(lambda: design.helmholtz_filter(GRID, 0.6)),
    "heaviside_projection": of_density(
        design.heaviside_projection, jnp.asarray(6.0), jnp.asarray(0.4)
    ),
    "greyness": of_density(design.greyness),
    "sensitivity_filtered": lambda: of_density(
        lambda x, g, smooth: design.sensitivity_filtered(smooth, x, g),
        jnp.asarray(drawn(1.0, 6)), design.cone_filter(GRID, 0.6),
    ),
    "layout": planned,
    "flood": through(lambda: design.flood(GRID, [1], threshold=0.7)),
    "darcy": lambda: of_density(seeping, GRID.points, 0.3, SEEPS, jit=False),
}  # fmt: skip


# ---- bodies of a density


def stretched(problem):
    x, y = problem.mesh.points.T
    return 0.05 * jnp.stack([jnp.sin(2 * x + y), jnp.cos(x - 3 * y)], axis=1)


def energy(density, problem):
    """Of cells that are solid, in between, and void."""
    made = design.graded(problem, SIMP(density), threshold=0.2, sharpness=10.0)
    return fem.potential_energy(made, stretched(problem))


def interpolated(density, base, interpolation):
    made = design.interpolated_energy(
        base, interpolation(density), threshold=0.2, sharpness=10.0
    )
    F = jnp.eye(3) + 0.1 * jnp.asarray(drawn(1.0, (3, 3)))
    columns = tuple(tuple(jnp.broadcast_to(x, (6,)) for x in row) for row in F)
    return material.strain_energy_density(made, columns)


def pushed(per):
    def at(share, value, problem):
        load = design.void_pressure(problem.mesh, share, value, per=per, name="air")
        return fem.residual(design.replaced_load(problem, load), stretched(problem))

    return at


def air():
    return body(PULL, design.void_pressure(GRID, jnp.zeros(6), 0.1, name="air"))


def followed(density, problem):
    follower = design.Follower(newton=SHARP)
    u = follower(design.graded(problem, SIMP(density))).displacement
    return u, design.work_of_loads(problem, u)


def held():
    """Linearised at rest, with a stiffness beside that of its cells."""
    return body(PULL, fem.Foundation(RIGHT, 0.1))


def small(verb, *more):
    """Of a linear model by all its numbers."""
    return lambda: of_density(
        lambda x, model, *more: verb(model, SIMP(x), *more), design.linear(held()), *more
    )


CASES |= {
    "interpolated_energy": lambda: of_density(interpolated, RUBBER, SIMP),
    "graded": lambda: of_density(energy, body()),
    "graded and solved by a Follower": lambda: of_density(followed, body(), jit=False),
    "void_pressure": lambda: of_density(pushed("cell"), jnp.asarray(0.1), air()),
    "void_pressure by node": lambda: Case(
        lambda at: pushed("node")(*at),
        (jnp.asarray(drawn(1.0, GRID.num_nodes)), jnp.asarray(0.1), air()),
        forward=False, step=1e-4,
    ),
    "replaced_load": lambda: of_density(
        lambda x, problem: design.replaced_load(problem, fem.Force(RIGHT, x[:2])), body()
    ),
    "linear": lambda: Case(design.linear, held(), forward=False, step=1e-4),
    "displacement": small(design.displacement),
    "displacement by another force": small(
        design.displacement, jnp.asarray(drawn(0.1, GRID.points.shape))
    ),
    "compliance": small(design.compliance),
}  # fmt: skip


# ---- what a design is judged by


def judged(verb, *more):
    """`verb(problem, u, *more)`."""

    def make():
        problem = air()
        at = (problem, stretched(problem), *more)
        return Case(lambda at: verb(*at), at, forward=False)

    return make


def path_error(problem, u, targets):
    path = Path(problem, jnp.stack([u, 2 * u]), targets, "force", Status.successful, None)
    return design.path_error(path, RIGHT, targets)


CASES |= {
    "work_of_loads": judged(design.work_of_loads),
    "displacement_along": judged(
        lambda problem, u, way: design.displacement_along(u, RIGHT, way),
        jnp.asarray([0.6, 0.8]),
    ),
    "rotation": judged(lambda problem, u: design.rotation(problem, u, RIGHT)),
    "mechanism": judged(
        lambda problem, u, output, w: design.mechanism(
            problem, u, output, output_weight=w[0], work_weight=w[1]
        ),
        jnp.asarray(0.3),
        jnp.asarray([2.0, 0.5]),
    ),
    "path_error": judged(path_error, jnp.asarray([[1.0, 0.3], [0.9, 0.4]])),
}


# ---- whole designs


def chamber():
    """The loss of `optimise_pneunet`, by the variables and all numbers of the body."""
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4)
    cell = design.pneunet_cell(rubber, divisions=(4, 6), pressure=2e3, wall=0.004, base=0.005)

    def at(numbers):
        problem, x, sharpness = numbers
        here = eqx.tree_at(lambda c: c.problem, cell, problem)
        u = fem.solve(pneunet.body_of(here, x, sharpness), newton=SHARP).displacement
        return pneunet.output(here, u), here.plan.volume_fraction(here.plan(x, sharpness))

    numbers = cell.problem, cell.start, jnp.asarray(4.0)
    return Case(at, numbers, jit=False, forward=False, step=1e-5)


def drawn_out():
    flat = design.SplineField(drawn(1.0, (5, 4)), [0.0, 0.1], 0.3)
    points = jnp.asarray(np.random.default_rng(2).uniform(0.1, 0.9, (5, 3)))

    def at(numbers):
        flat, thickness, points = numbers
        whole = design.solid(design.Part(flat, flat, 1.0, 1.0, 0.5, 0.0), thickness)
        return flat(points[:, :2]), whole(points)

    return Case(at, (flat, jnp.asarray(0.7), points), forward=False, step=1e-5)


def fitted():
    """The columns of an experiment, as `calibrate` takes them, against its errors."""
    problem = body()

    def predict(numbers):
        rubber = material.NeoHookean(*numbers)
        made = dataclasses.replace(problem, material=rubber)
        return fem.solve(made, newton=SHARP).displacement[RIGHT]

    experiment = design.Experiment(predict, np.full((3, 2), 0.01), 1e-3)

    @jax.custom_jvp
    def errors(numbers):
        return sensitivity(experiment, numbers, (jnp.eye(2)[0], jnp.eye(2)[1]))[0]

    @errors.defjvp
    def _(primals, tangents):
        found, columns = sensitivity(experiment, primals[0], (jnp.eye(2)[0], jnp.eye(2)[1]))
        return jnp.asarray(found), jnp.asarray(columns) @ jnp.stack(tangents[0])

    return Case(errors, (jnp.asarray(0.4), jnp.asarray(2.0)), jit=False, step=1e-4)


CASES |= {
    "pneunet_cell": chamber,
    "solid": drawn_out,
    "sensitivity of an experiment": fitted,
}
