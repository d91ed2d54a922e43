"""Slopes of bodies: their energy and forces by every number, and what is solved for on them."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax import fem, material, mesh, sdf
from sorojax.fem.contact.obstacle import untouched
from tests.derivatives.case import Case
from tests.patches import POLYGON, patch

NONE = {
    "topology, on the host: pairs of nodes, patches of cells, cells that hold points": (
        "space patches route rigid glue"
    ),
    "pairs of facets, on the host": "self_crossings",
    "lists which facets are near, at concrete positions only": "update_contact_pairs",
    "paths and predictions found on the host; their docstrings promise no derivative": (
        "continuation critical_loads"
    ),
    "tells where the derivative of a motion jumps": "contact_switching",
}

RUBBER = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.4, density=1.3)
DEPTH = fem.PlaneStrain(0.7)
SHARP = fem.Newton(residual_tolerance=1e-12, step_tolerance=1e-9)


def drawn(size, shape, seed=3):
    return np.random.default_rng(seed).uniform(-size, size, shape)


def uneven(cells):
    """`cells` with every node a little off its place."""
    return eqx.tree_at(
        lambda m: m.points, cells, cells.points + drawn(0.04, cells.points.shape)
    )


PLATE = uneven(mesh.rectangle([0, 0], [1.5, 0.5], divisions=(3, 1)))
LEFT, RIGHT = PLATE.node_sets["left"], PLATE.node_sets["right"]
ABOVE, BELOW = PLATE.facet_sets["top"], PLATE.facet_sets["bottom"]
CLAMP, ENDS = (fem.Fixed(LEFT),), (fem.Fixed(LEFT), fem.Fixed(RIGHT))
WAY = ([0.2, 0.2], [0.7, 0.3], [1.2, 0.2])


def plate(*loads, supports=CLAMP, rubber=RUBBER, kinematics=DEPTH, cells=PLATE, **options):
    return fem.problem(
        cells, rubber, kinematics=kinematics, supports=supports, loads=loads, **options
    )


def moved(problem, size=0.03):
    """`problem` and a smooth displacement of its nodes, of any shape."""
    points = problem.mesh.points
    xp = jnp if isinstance(points, jax.core.Tracer) else np  # programs only where traced
    x, y, *_ = xp.asarray(points).T
    wave = [xp.sin(2 * x + y), xp.cos(x - 3 * y), xp.sin(x + 2 * y)]
    return problem, jnp.asarray(size * xp.stack(wave[: problem.mesh.element.dim], axis=1))


def at_state(verb, make, **options):
    options = {"forward": False, "step": 1e-4} | options
    return lambda: Case(lambda at: verb(*at), moved(make()), **options)


# ---- energy and force by the data of every kind of term, material, element and kinematics


def ball(radius=1.05):
    return sdf.Circle([0.7, -1.0], radius)


def touching(radius=1.05, **options):
    return fem.Contact(BELOW, ball(radius), 20.0, 0.001, **options)


def two_plates():
    both = mesh.merge(
        upper=mesh.rectangle([0.03, 0.46], [0.83, 0.9], divisions=(1, 1)),
        lower=mesh.rectangle([0, 0], [1.0, 0.5], divisions=(1, 1)),
    )
    contact = fem.SelfContact(
        both.facet_sets["upper.bottom"], both.facet_sets["lower.top"], 20.0, 0.001
    )
    held = np.concatenate([both.node_sets["upper.top"], both.node_sets["lower.bottom"]])
    return plate(contact, supports=(fem.Fixed(held),), cells=both)


SOLID = patch(mesh.Hex8(), (0.0, 0.0, 0.0))
SPATIAL = np.array([[0.1, 0.2, 0.15], [0.5, 0.4, 0.3], [0.85, 0.6, 0.8]])


def backbone(cells, way=WAY, **options):
    """Curved at rest, so that the directions of its sections count in space."""
    options = {"axial_stiffness": 2.0, "bending_stiffness": 0.02, "spacing": 0.3} | options
    return fem.embedded_rod(cells, np.asarray(way), value=0.01, **options)


def in_space(rod):
    held = mesh.nodes_where(SOLID, lambda p: p[0] < 1e-9)
    return fem.problem(SOLID, RUBBER, supports=(fem.Fixed(held),), loads=(rod,))


def slipping(cells):
    """Some of the bond slides at the state of `moved`."""
    numbers = {"bond_strength": 0.02, "bond_stiffness": 3.0, "tie_stiffness": 20.0}
    wider, rod = fem.bonded_rod(cells, backbone(cells), **numbers)
    return plate(rod, cells=wider)


def glued():
    both = mesh.merge(
        upper=mesh.rectangle([0, 0.5], [1.5, 1.0], divisions=(2, 1)),
        lower=mesh.rectangle([0, 0], [1.5, 0.5], divisions=(3, 1)),
    )
    seam = fem.glue(
        both, both.facet_sets["upper.bottom"], both.facet_sets["lower.top"], stiffness=20.0
    )
    return plate(seam, supports=(fem.Fixed(both.node_sets["lower.bottom"]),), cells=both)


TERMS = {
    "Pressure": lambda: plate(fem.Pressure(ABOVE, 0.02, origin=[0.1, 0.2]), supports=ENDS),
    "Traction": lambda: plate(fem.Traction(ABOVE, [0.02, -0.03])),
    "Force": lambda: plate(fem.Force(RIGHT, [0.02, 0.03])),
    "Gravity": lambda: plate(fem.Gravity([0.02, 0.03])),
    "Torque": lambda: plate(fem.Torque(RIGHT, 0.02)),
    "Spring to nodes": lambda: plate(fem.Spring([1, 6], [4, 3], [0.2, 0.3], 0.01)),
    "Spring to the ground": lambda: plate(fem.Spring(RIGHT, [2.0, 0.7], 0.2, 0.01)),
    "Foundation": lambda: plate(fem.Foundation(RIGHT, [0.3, 0.2], [0.01, 0.02])),
    "Tendon": lambda: plate(fem.Tendon(fem.route(PLATE, WAY), 0.1)),
    "Cable": lambda: plate(fem.Cable(fem.route(PLATE, WAY), 0.5, 0.3)),
    "Rigid": lambda: plate(fem.rigid(PLATE, RIGHT)),
    "EmbeddedRod": lambda: plate(backbone(PLATE)),
    "EmbeddedRod in space": lambda: in_space(backbone(SOLID, SPATIAL, axial_stiffness=3.0)),
    "BondedRod": lambda: slipping(PLATE),
    "Contact": lambda: plate(touching(offset=np.full((3, 2), 0.01))),
    "Contact with friction": lambda: plate(touching(friction=0.4)),
    "SelfContact": two_plates,
    "Glue": glued,
}
MATERIALS = {
    "NeoHookean": lambda: material.NeoHookean(0.4, 2.0),
    "MooneyRivlin": lambda: material.MooneyRivlin(
        0.2, 0.1, 2.0, volumetric=material.SimoMiehe()
    ),
    "Yeoh": lambda: material.Yeoh(0.2, 0.1, 0.05, 2.0, volumetric=material.SimoTaylor()),
    "Gent": lambda: material.Gent(0.4, 20.0, 2.0, volumetric=material.Logarithmic()),
    "Ogden": lambda: material.Ogden((0.4, 0.1), (1.3, 3.0), 2.0),
    "StVenantKirchhoff": lambda: material.StVenantKirchhoff(0.4, 2.0),
    "CompressibleNeoHookean": lambda: material.CompressibleNeoHookean(0.4, 2.0),
    "one number per cell": lambda: material.NeoHookean(
        0.4 + drawn(0.1, PLATE.num_cells), 2.0, density=1.0 + drawn(0.1, PLATE.num_cells)
    ),
}
CELLS = {
    "Tri3": (mesh.Tri3(), DEPTH), "Tri6": (mesh.Tri6(), fem.Axisymmetric()),
    "Tri7": (mesh.Tri7(), fem.Axisymmetric()), "Quad4": (mesh.Quad4(), DEPTH),
    "Quad8": (mesh.Quad8(), fem.PlaneStress(0.7)), "Quad9": (mesh.Quad9(), DEPTH),
    "PolyN": (POLYGON, fem.Axisymmetric()), "Tet4": (mesh.Tet4(), fem.Solid()),
    "Tet10": (mesh.Tet10(), fem.Solid()), "Tet15": (mesh.Tet15(), fem.Solid()),
    "Hex8": (mesh.Hex8(), fem.Solid()),
}  # fmt: skip


def of_cells(element, kinematics):
    off = 0.5 if isinstance(kinematics, fem.Axisymmetric) else 0.0  # from the axis
    cells = patch(element, (off, 0.0, 0.0))
    held = mesh.nodes_where(cells, lambda p: p[1] < 1e-9)
    return plate(cells=cells, kinematics=kinematics, supports=(fem.Fixed(held),))


def of_material(make):
    return plate(rubber=make())


BODIES = {name: functools.partial(of_material, make) for name, make in MATERIALS.items()} | {
    f"{name} cells": functools.partial(of_cells, *made) for name, made in CELLS.items()
}
#: Whose slopes have rules of their own.
RULED = ("Contact", "SelfContact", "Quad4 cells", "Quad8 cells")
CASES = {
    f"{verb.__name__} of {name}": at_state(verb, make)
    for name, make in (TERMS | BODIES).items()
    for verb in (fem.residual if name in RULED else fem.potential_energy,)
    if name != "Contact with friction"
}


def after_friction():
    """Some points held and some sliding since the state that friction knows of."""
    problem, u = moved(TERMS["Contact with friction"]())
    gripped = fem.update_friction(problem, u)
    return Case(lambda at: fem.residual(*at), (gripped, u + 5e-3), step=1e-5, forward=False)


CASES["residual of Contact with friction"] = after_friction


# ---- measured on a state


def quads():
    cells = uneven(mesh.rectangle([0, 0], [1.5, 0.5], divisions=(2, 1), element=mesh.Quad4()))
    return plate(cells=cells, supports=(fem.Fixed(cells.node_sets["left"]),))


def sheet():
    return plate(kinematics=fem.PlaneStress(0.7))


def of_nodes(problem, u):
    fit = fem.patches(PLATE)
    return fem.nodal_stress(problem, u, fit)


def first_touch(problem, u):
    """What friction remembers is not varied: no pressure is below zero."""
    (contact,) = problem.loads
    bare = eqx.tree_at(lambda p: p.loads, problem, (untouched(contact, problem.mesh),))
    return fem.update_friction(bare, u)


def points_of(problem, u):
    return fem.sample_points(problem.mesh)


def averaged(problem, u):
    return fem.nodal_average(problem, fem.cauchy_stress(problem, u))


MEASURES = {
    "cauchy_stress": (fem.cauchy_stress, quads),
    "cauchy_stress of a sheet": (fem.cauchy_stress, sheet),
    "deformation_gradient of a sheet": (fem.deformation_gradient, sheet),
    "von_mises_stress": (fem.von_mises_stress, plate),
    "principal_stresses": (fem.principal_stresses, plate),
    "nodal_stress": (of_nodes, plate),
    "nodal_average": (averaged, plate),
    "sample_points": (points_of, quads),
    "strain_energy": (fem.strain_energy, sheet),
    "enclosed_volume": (lambda p, u: fem.enclosed_volume(p, u, jnp.asarray(ABOVE)), plate),
    "reaction_force": (lambda p, u: fem.reaction_force(p, u, jnp.asarray(LEFT)), plate),
    "reactions": (lambda p, u: fem.reactions(p, u, about=u[1]), lambda: loaded()),
    "mass_matrix": (lambda p, u: fem.mass_matrix(p), quads),
    "lumped_mass": (lambda p, u: fem.lumped_mass(p), quads),
    "total_mass": (lambda p, u: fem.total_mass(p), quads),
    "tension": (lambda p, u: fem.tension(p, u, "cable"), TERMS["Cable"]),
    "tendon_length": (
        lambda p, u: fem.tendon_length(p.mesh, u, p.loads[0].route), TERMS["Cable"],
    ),
    "rod_forces": (fem.rod_forces, TERMS["EmbeddedRod in space"]),
    "rod_forces of a rod that slips": (fem.rod_forces, TERMS["BondedRod"]),
    "update_friction of a bond": (fem.update_friction, TERMS["BondedRod"]),
    "contact_state": (fem.contact_state, TERMS["Contact"]),
    "overlap": (fem.overlap, TERMS["Contact"]),
    "update_friction": (first_touch, TERMS["Contact with friction"]),
    "with_imperfection": (
        lambda p, u: fem.with_imperfection(p, u, jnp.sum(p.kinematics.thickness)), plate,
    ),
    "with_load": (lambda p, u: fem.with_load(p, "force", 3 * u[0]), TERMS["Force"]),
}  # fmt: skip
CASES |= {name: at_state(verb, make) for name, (verb, make) in MEASURES.items()}


def wound(at):
    """From the points of the rod and of the mesh, by the cells that hold it."""
    way, points, numbers = at
    cells = eqx.tree_at(lambda m: m.points, SOLID, points)
    rod = fem.embedded_rod(
        cells, way, radius=numbers[0], young_modulus=numbers[1], matrix=RUBBER, spacing=0.3,
        density=numbers[2],
    )  # fmt: skip
    both, free = fem.bonded_rod(cells, rod, bond_strength=numbers[3], material=RUBBER)
    problem, u = moved(in_space(rod))
    wide = dataclasses.replace(problem, mesh=both, loads=(free,))
    return fem.potential_energy(problem, u), free.lumped_mass(wide), free.tie_stiffness


CASES |= {
    name: Case(
        wound,
        (jnp.asarray(SPATIAL), SOLID.points, jnp.asarray([0.1, 40.0, 2.0, 0.3])),
        jit=False,
        forward=False,
        step=1e-5,
        rtol=1e-6,
    )
    for name in ("embedded_rod", "bonded_rod")
}
ARC = drawn(1.0, (4, 3)), jnp.asarray(0.4), drawn(1.0, 3), drawn(1.0, 3, 4)
CASES |= {
    "rotated": Case(lambda at: fem.rotated(*at), tuple(map(jnp.asarray, ARC))),
    "rotated in the plane": Case(
        lambda at: fem.rotated(*at), (ARC[0][:, :2], jnp.asarray(0.4), ARC[2][:2])
    ),
    "mean_rotation": Case(
        lambda at: fem.mean_rotation(at[0], at[0] + fem.rotated(*at), at[3]),
        tuple(map(jnp.asarray, ARC)),
    ),
}


# ---- solved for


def given(problem):
    """The numbers of a problem that are a user's: contacts remember some more."""
    bare = [
        dataclasses.replace(load, grip=None, place=None)
        if isinstance(load, fem.Contact)
        else load
        for load in problem.loads
    ]
    return dataclasses.replace(problem, loads=tuple(bare))


def solved(make, verb=None, **options):
    """Slopes of equilibria, found on the host to the last digits."""
    verb = verb or (lambda problem: fem.solve(problem, newton=SHARP).displacement)
    options = {"forward": False, "step": 1e-4} | options
    return lambda: Case(verb, make(), jit=False, **options)


def loaded(**options):
    """Loads and supports that move; of those that name a node twice the last one counts."""
    turned = fem.Rotated(RIGHT, PLATE.points[RIGHT], 0.05, [1.5, 0.3])
    lifts = fem.Prescribed(RIGHT[:1], 0.05, components=(1,))
    return plate(
        fem.Traction(ABOVE, [0.01, -0.03]),
        fem.Pressure(BELOW, 0.02),
        fem.Gravity([0.02, 0.03]),
        fem.Cable(fem.route(PLATE, WAY), 0.5, -0.3, name="slack"),
        fem.Cable(fem.route(PLATE, WAY[1:]), 0.5, 0.1),
        supports=(fem.Fixed(LEFT), fem.Fixed(LEFT[:1], (0,)), turned, lifts),
        **options,
    )


def built(at):
    """From the numbers that a user has: the defaults of terms follow them too."""
    points, moduli, force = at
    cells = eqx.tree_at(lambda m: m.points, PLATE, points)
    rubber = material.NeoHookean(*moduli)
    loads = fem.Force(RIGHT, force), fem.rigid(PLATE, RIGHT), fem.Contact(BELOW, ball())
    return fem.potential_energy(*moved(plate(*loads, cells=cells, rubber=rubber)))


def incompressible():
    cells = uneven(mesh.rectangle([0, 0], [1.5, 0.5], divisions=(2, 1), element=mesh.Quad4()))
    rubber = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.49999)
    left, right = (cells.node_sets[side] for side in ("left", "right"))
    pull = fem.Prescribed(right, [0.1, 0.05])
    return plate(cells=cells, rubber=rubber, supports=(fem.Fixed(left), pull))


def pressed(**options):
    """Onto a ball: some points touch and others do not."""
    return plate(fem.Gravity([0.0, -0.05]), touching(**options))


SOLVED = {
    "solve": loaded,
    "solve a sheet": lambda: loaded(kinematics=fem.PlaneStress(0.7)),
    "solve a nearly incompressible body": incompressible,
    "solve with contact": pressed,
}
CASES |= {name: solved(make, forward=name == "solve") for name, make in SOLVED.items()}


def hanging():
    """At rest over a ball that its points would rub on."""
    problem = plate(fem.Force(RIGHT, [0.0, 0.0]), touching(0.93, friction=0.4))

    def at(numbers):
        return fem.solve(eqx.combine(numbers, problem), newton=SHARP).displacement

    return Case(at, given(problem), jit=False, forward=False, step=1e-4)


CASES["solve at rest over a ball with friction"] = hanging
CASES["problem"] = lambda: Case(
    built,
    (PLATE.points, (jnp.asarray(0.4), jnp.asarray(2.0)), jnp.asarray([0.02, 0.01])),
    step=1e-4,
    forward=False,
    jit=False,
)


def along_path(at):
    problem, values = at
    return fem.solve_path(problem, newton=SHARP, traction=values).displacements


def lifted(problem):
    """All updates are made: no overlap is small enough."""
    options = {"penetration": 1e-15, "max_updates": 2, "throw": False, "newton": SHARP}
    found = fem.solve_contact(problem, **options)
    return found.displacement, found.problem.loads[-1].offset


def sealed():
    """A plate under a closed room, and air in it that is a little too much."""
    problem = plate(fem.Pressure(ABOVE, 1.0, origin=[0.7, 1.0], name="air"), supports=ENDS)
    room = -problem.loads[0].potential(problem, jnp.zeros_like(PLATE.points))
    return problem, fem.Gas(1.05 * room, 0.01, 1.4, 0.5)


def filled(at):
    found = fem.solve_volume(at[0], newton=SHARP, air=at[1])
    return found.displacement, found.pressures, found.volumes


def flooded(at):
    problem, air = at
    rows = jnp.stack([0.98 * air.volume, air.volume])
    found = fem.volume_path(problem, newton=SHARP, air=rows)
    return found.displacements, found.pressures


CASES |= {
    "solve_path": solved(
        lambda: (loaded(), jnp.asarray([[0.01, 0.02], [0.02, 0.05]])), along_path
    ),
    "solve_contact": solved(pressed, lifted),
    "solve_volume of a gas": solved(sealed, filled),
    "solve_volume of a liquid": solved(
        lambda: (sealed()[0], fem.Liquid(sealed()[1].volume, 3.0)), filled
    ),
    "volume_path": solved(sealed, flooded),
}


# ---- vibration and motion


def shaken(problem):
    u = fem.solve(problem, newton=SHARP).displacement
    return fem.eigenmodes(problem, u, 3)


def stiffness_along(problem, u):
    """Of a sheet, whose energy has a minimum in it: its third derivative."""
    way = jnp.cos(5 * u)
    return jax.jvp(lambda u: fem.residual(problem, u), (u,), (way,))[1]


def modal(verb):
    """With `numbers`, as many as there are modes or unknowns."""

    def at(numbers):
        modes, given = numbers
        return verb(modes, given)

    def make():
        modes = fem.eigenmodes(loaded(), count=2)
        shape = (2,) if verb is fem.modal_displacement else PLATE.points.shape
        return Case(at, (modes, jnp.asarray(drawn(1.0, shape))), jit=False, forward=False)

    return make


def moving(problem, method, damping=(), measure=None, **options):
    """Three steps of what has begun to move, its first load growing."""
    name = problem.loads[0].name
    row = np.linspace(0.5, 1.0, 4)[:, None] * np.asarray(problem.loads[0].value)
    start = [drawn(0.01, PLATE.points.shape, seed) for seed in (1, 2)]
    start = tuple(jnp.asarray(x).at[LEFT].set(0.0) for x in start)

    def at(numbers):
        own, method, damping, row, start = numbers
        motion = fem.simulate(
            eqx.combine(own, problem),
            0.6,
            0.2,
            start=start,
            method=method,
            damping=damping,
            newton=SHARP,
            **options,
            **{name: row},
        )
        if measure is not None:
            return measure(motion)
        return motion.displacements, motion.velocities, motion.energies

    numbers = given(problem), method, damping, jnp.asarray(row), start
    return Case(at, numbers, jit=False, forward=False, step=1e-4)


VISCOUS = (fem.Rayleigh(0.1, 0.02), fem.KelvinVoigt(0.03))
PULLED = functools.partial(plate, fem.Gravity([0.02, 0.03]), fem.Force(RIGHT, [0.02, 0.03]))
ALPHA = fem.GeneralisedAlpha(0.6)
CASES |= {
    "eigenmodes": solved(TERMS["Force"], shaken),
    "tangent_modes": solved(
        lambda: moved(TERMS["Pressure"]()), lambda at: fem.tangent_modes(*at, 2)
    ),
    "residual of a sheet and its stiffness": at_state(stiffness_along, sheet),
    "modal_displacement": modal(fem.modal_displacement),
    "modal_coordinates": modal(fem.modal_coordinates),
    "modal_force": modal(fem.modal_force),
    "simulate": lambda: moving(PULLED(), ALPHA, VISCOUS),
    "simulate with contact": lambda: moving(pressed(friction=0.4), ALPHA),
    "reaction_history": lambda: moving(PULLED(), ALPHA, measure=fem.reaction_history),
    "momentum": lambda: moving(
        PULLED(), fem.Newmark(0.3, 0.55), measure=fem.momentum, mass="lumped"
    ),
}

#: What takes seconds to compile and is like another case.
SLOW = (
    *(f"potential_energy of {kind} cells" for kind in ("Tri6", "Tri7", "Quad9", "Tet4")),
    *(f"potential_energy of {kind}" for kind in ("MooneyRivlin", "Yeoh", "Ogden")),
    "potential_energy of PolyN cells", "potential_energy of Tet15 cells",
    "residual of SelfContact", "residual of Contact with friction", "residual of Quad8 cells",
    "solve a sheet", "solve at rest over a ball with friction", "problem", "tangent_modes",
    "simulate", "simulate with contact",
)  # fmt: skip
