"""Impacts of finite elements on a wall, on another body and on themselves, and oblique ones
on a wall with friction, over speeds, walls and steps: what gets through, and the largest energy
over that before."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from benchmarks.cases.contact_grid import outcomes
from sorojax import fem, material, mesh, sdf
from sorojax.units import mm

SPEEDS, WALLS = (5.0, 10.0, 20.0, 50.0, 100.0), (1.0, 2.0, 5.0, 10.0, 20.0)  # [m/s], [mm]
STEPS = (2e-5, 2e-4, 1e-3)  # [s]
RUBBER = material.neo_hookean(young_modulus=1e8, poisson_ratio=0.3, density=1000.0)
GAP = 3 * mm


def plate(size, divisions, corner):
    ends = np.asarray(corner), np.asarray(corner) + np.asarray(size)
    return mesh.rectangle(*ends, divisions=divisions, element=mesh.Quad4())


def body(shape, *loads):
    return fem.problem(
        shape,
        RUBBER,
        kinematics=fem.PlaneStrain(0.03),
        supports=(),
        loads=loads,
        formulation=fem.Displacement(),
        free=True,
    )


def on_a_shape(wall, friction=None):
    """A plate over a wall; how fast it falls, aslant with friction, and by how much its
    underside stays above."""
    shape = plate([20 * mm, 5 * mm], (4, 1), [0, GAP])
    under, obstacle = shape.facet_sets["bottom"], sdf.Rectangle([-3.0, -wall], [3.0, 0.0])
    ids = np.unique(under)
    falls = jnp.zeros_like(shape.points).at[:, 1].set(-1.0)
    falls = falls if friction is None else falls.at[:, 0].set(1.0)
    problem = body(shape, fem.Contact(under, obstacle, friction=friction))
    return problem, falls, lambda x: x[:, ids, 1].min() + wall


def on_a_plate(wall):
    """A plate over a wider one, both free."""
    shape = mesh.merge(
        a=plate([20 * mm, 5 * mm], (4, 1), [0, GAP]),
        b=plate([40 * mm, wall], (8, 1), [-10 * mm, -wall]),
    )
    facets, nodes = shape.facet_sets, shape.node_sets
    falls = jnp.zeros_like(shape.points).at[nodes["a"], 1].set(-1.0)
    x = np.asarray(shape.points)[nodes["b.bottom"], 0]
    low = nodes["b.bottom"][(x > 2 * mm) & (x < 18 * mm)]

    def above(x):
        return (x[:, nodes["a.bottom"], 1].mean(axis=1) - x[:, low, 1].mean(axis=1)).min()

    return body(shape, fem.SelfContact(facets["a.bottom"], facets["b.top"])), falls, above


def on_itself(wall):
    """A fork whose two lips are thrown at each other."""
    x = np.concatenate([[-5 * mm], np.linspace(0, 30 * mm, 7)])
    y = np.array([-GAP / 2 - wall, -GAP / 2, GAP / 2, GAP / 2 + wall])
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = np.array([4 * i + j for i in range(7) for j in range(3) if j != 1 or i == 0])
    shape = mesh.Mesh(points, corners[:, None] + np.array([0, 4, 5, 1]), mesh.Quad4())
    at = 4 * np.arange(1, 7)
    facets = np.stack([np.stack([at + 2, at + 6], 1), np.stack([at + 5, at + 1], 1)])
    share = np.clip(points[:, 0] / (30 * mm), 0, None) * np.sign(points[:, 1]) / 2
    closes = jnp.zeros_like(shape.points).at[:, 1].set(-share)
    upper = 4 * np.arange(2, 8) + 2

    def apart(x):
        return (x[:, upper, 1] - x[:, upper - 1, 1]).min() + wall / 4

    return body(shape, fem.SelfContact(facets.reshape(-1, 2))), closes, apart


SCENES = {
    "shape": on_a_shape,
    "shape, friction 0.3": partial(on_a_shape, friction=0.3),
    "shape, friction 0.8": partial(on_a_shape, friction=0.8),
    "body": on_a_plate,
    "itself": on_itself,
}


def impact(scene, speed, wall, step):
    """A motion of ten steps, how much of the wall was left, and its largest energy over that
    before."""
    problem, thrown, left = scene(wall * mm)
    start = jnp.zeros_like(thrown), speed * thrown
    motion = fem.simulate(problem, 10 * step, step, start=start)
    energies = motion.energies
    energy = np.asarray(energies.kinetic + energies.elastic + energies.loads)
    places = np.asarray(problem.mesh.points) + np.asarray(motion.displacements)
    return left(places), energy.max() / energy[0]


def rows():
    for kind, scene in SCENES.items():
        for step in STEPS:
            through, unresolved, ratios = [], [], []
            for speed in SPEEDS:
                for wall in WALLS:
                    where = f"{speed:g} m/s, {wall:g} mm"
                    try:
                        left, most = impact(scene, speed, wall, step)
                    except fem.MotionError:
                        unresolved.append(where)
                        continue
                    through += [where] if left <= 0 else []
                    ratios.append(float(most))
            settings = {
                "kind": kind,
                "step": step,
                "runs": len(SPEEDS) * len(WALLS),
                "unresolved": len(unresolved),
                "which": "; ".join(through + unresolved),
            }
            yield from outcomes(settings, float(len(through)), max(ratios))
