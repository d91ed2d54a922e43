"""Solids in a few shapes on links: they move as whole solids do there, and as rigid ones."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, SE3, Status, fem, material, mesh, replace, rod, sdf, systems
from sorojax.systems.blocks.modal_basis import Basis, orthonormal
from tests.test_systems_carried import ARM, LENGTH, WIDTH, G, compound, pendulum

METHOD = systems.Rodas4()


def reduced(ratio, modulus=1e7, modes=4) -> Any:
    """The pendulum of a link and a solid, with the solid in a few shapes."""
    whole = pendulum(ratio, modulus)
    solid, arm = whole.blocks["solid"], whole.blocks["arm"]
    small = systems.modal_body(solid, systems.modal_basis(solid, modes))
    arm = systems.AssemblyBody(arm.assembly, arm.forces)
    return systems.Network({"arm": systems.CarryingBody(arm, {"bar": small})}, {})


@pytest.mark.parametrize("ratio", [0.1, 10.0])
def test_a_stiff_solid_in_a_few_shapes_swings_as_one_rigid_pendulum(ratio):
    film = systems.simulate(reduced(ratio), 0.4, solver=METHOD, step=5e-4, save=11)
    assert film.status == Status.successful
    want = compound(ratio, np.asarray(film.time))
    assert np.abs(np.asarray(film.state["arm"]["q"][:, 0]) - want).max() < 1e-4


def turning_finger(order=3) -> Any:
    """A soft finger in space, askew on a link on a ball joint, and the link's block."""
    cells = mesh.box([0, 0, 0], [0.05, 0.01, 0.01], divisions=(4, 1, 1), element=mesh.Hex8())
    root = cells.node_sets["left"]
    pose = (
        jnp.eye(4)
        .at[:3, :3]
        .set(jnp.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]))
    )
    pose = pose.at[:3, 3].set(jnp.array([-0.02, 0.01, 0.005]))
    problem = fem.problem(
        cells,
        material.neo_hookean(young_modulus=3e5, poisson_ratio=0.3, density=1000.0),
        supports=(fem.Carried(root, cells.points[root], rest=pose, name="grip"),),
        loads=(fem.Gravity([0.0, 0.0, -G]),),
    )
    solid = systems.FemBody(problem, driven=("grip",), energies=True)
    link = rod.Link(0.01, [3e-6, 4e-6, 5e-6], [0.0, 0.01, 0.0])
    base = jnp.eye(4).at[:3, :].set(pose[:3, :])
    arm = rod.assembly(SE3(), hand=rod.Part(link, rod.Spherical(), offset=base))
    v = jnp.array([4.0, -3.0, 5.0])
    return solid, systems.AssemblyBody(arm, (rod.Gravity([0.0, 0.0, -G]),), v=v)


def every_shape(solid) -> Basis:
    """All that the free nodes can do, of unit modal mass."""
    points = solid.problem.mesh.points
    free = np.setdiff1d(np.arange(len(points)), solid.problem.supports[0].nodes)
    rows = np.zeros((3 * len(free), *points.shape))
    for k, (node, axis) in enumerate((n, a) for n in free for a in range(3)):
        rows[k, node, axis] = 1.0
    system, mass = solid.problem.space.system, solid.matter().mass
    shapes = orthonormal(system, mass, jnp.asarray(rows.reshape(len(rows), -1)))
    return Basis(jnp.zeros_like(points), shapes.reshape(-1, *points.shape))


def test_it_turns_and_bends_in_space_as_the_whole_solid_does():
    """Every shape of the mesh is kept, so that what is left are the steps of both runs."""
    solid, arm = turning_finger()
    basis = every_shape(solid)
    small = systems.modal_body(solid, basis, order=None)
    whole = systems.Network({"arm": systems.CarryingBody(arm, {"hand": small})}, {})
    film = systems.simulate(whole, 0.03, solver=METHOD, step=2.5e-4, save=4)
    assert film.status == Status.successful

    carrying = replace(arm, lambda a: a.v, arm.v)
    carrying = systems.AssemblyBody(arm.assembly, arm.forces, v=arm.v, carrying=("hand",))
    start = _velocity(solid, arm)
    full = systems.Network(
        {"arm": carrying, "solid": systems.FemBody(solid.problem, driven=("grip",), v=start)},
        {"solid.grip": "arm.hand_pose", "arm.hand_reaction": "solid.grip_wrench"},
    )
    errors = []
    for step in (1e-3, 5e-4):
        seen = systems.simulate(full, 0.03, step=step, save=4)
        errors.append(float(jnp.max(jnp.abs(seen.state["arm"]["q"] - film.state["arm"]["q"]))))
    moved = float(jnp.max(jnp.abs(film.state["arm"]["q"][-1] - film.state["arm"]["q"][0])))
    assert errors[1] < 1e-2 * moved and errors[1] < 0.6 * errors[0]


def _velocity(solid, arm):
    """Of the nodes of a solid that turns with its link as if rigid [m/s]."""
    moment = rod.motion(arm.assembly, rod.rest(arm.assembly), arm.v)
    frame = moment.frames[0]
    rate = frame.rotation @ frame.twist[:3]
    return jnp.cross(rate[None], solid.problem.mesh.points - frame.position[None])


def test_the_wrench_on_it_changes_its_momentum():
    """Newton and Euler for the solid alone, by differences of what it holds in time."""
    solid, arm = turning_finger()
    small = systems.modal_body(solid, systems.modal_basis(solid, 3))
    whole = systems.Network({"arm": systems.CarryingBody(arm, {"hand": small})}, {})
    film = systems.simulate(whole, 4e-3, solver=METHOD, step=2e-5, save=201)
    inertia, state = small.inertia, film.state["arm"]

    def momentum(q, v, own):
        frame = rod.motion(arm.assembly, q, v).frames[0]
        now = inertia.moved(own["q"], own["v"], frame.twist[:3])
        both = (now.matrix @ frame.twist + now.coupling @ own["v"]).reshape(2, 3)
        turning, moving = both @ frame.rotation.T
        centre = frame.position + frame.rotation @ inertia.centre(own["q"])
        about = turning + jnp.cross(frame.position, moving)
        return jnp.concatenate([about, moving]), frame.position, centre

    held, place, centre = jax.vmap(momentum)(state["q"], state["v"], state["hand"])
    wrench = film.outputs["arm.hand_wrench"]
    torque = wrench[:, :3] + jnp.cross(place, wrench[:, 3:])
    weight = inertia.mass * jnp.array([0.0, 0.0, -G])
    torque = torque + jnp.cross(centre, weight[None])
    rates = jnp.concatenate([torque, wrench[:, 3:] + weight[None]], axis=1)
    seen = (held[2:] - held[:-2]) / (film.time[2:] - film.time[:-2])[:, None]
    off = jnp.max(jnp.abs(seen - rates[1:-1]), axis=0) / jnp.max(jnp.abs(rates), axis=0)
    assert jnp.max(off) < 1e-3


def test_its_energy_stays():
    network = reduced(1.0, modulus=1e5)
    film = systems.simulate(network, 0.2, solver=METHOD, step=2.5e-4, save=41)
    block = network.blocks["arm"]
    link, solid = block.arm.assembly.parts[0].body, block.solids["bar"]
    angle, rate = film.state["arm"]["q"][:, 0], film.state["arm"]["v"][:, 0]
    inertia = link.inertia + link.mass * link.center[0] ** 2
    of_link = inertia * rate**2 / 2 + link.mass * G * link.center[0] * jnp.sin(angle)
    centre = jax.vmap(solid.inertia.centre)(film.state["arm"]["bar"]["q"])
    height = centre[:, 0] * jnp.sin(angle) + centre[:, 1] * jnp.cos(angle)
    weight = solid.inertia.mass * G * height
    moving, bent = (film.outputs[f"arm.bar_{kind}_energy"] for kind in ("kinetic", "elastic"))
    total = of_link + weight + moving + bent
    size = float(jnp.max(moving))
    assert float(jnp.max(bent)) > 1e-3 * size
    assert jnp.max(jnp.abs(total - total[0])) < 1e-4 * size


def blown(closed=True) -> tuple[systems.FemBody, Any]:
    """The solid of a pendulum with a chamber above its middle, or one that is open where the
    link holds it, and the block of the link."""
    base = pendulum(1.0, 3e5)
    grid = mesh.rectangle(
        [ARM, -WIDTH / 2], [ARM + LENGTH, WIDTH / 2], divisions=(4, 4), element=mesh.Quad8()
    )
    low = jnp.array([ARM + (LENGTH / 4 if closed else -LENGTH), 0.0])
    high = jnp.array([ARM + 3 * LENGTH / 4, WIDTH / 4])
    kept = mesh.cells_where(grid, lambda p: jnp.any((p < low) | (p > high)))
    cells = mesh.submesh(grid, kept)
    air = fem.Pressure(mesh.facets_on(cells, sdf.Rectangle(low, high)), name="air")
    left = cells.node_sets["left"]
    old = base.blocks["solid"].problem
    problem = fem.problem(
        cells,
        old.material,
        kinematics=old.kinematics,
        supports=(fem.Carried(left, cells.points[left], name="grip"),),
        loads=(*old.loads, air),
    )
    return systems.FemBody(problem, driven=("grip", "air")), base.blocks["arm"]


def test_a_chamber_bends_a_solid_on_a_link_as_the_whole_one():
    solid, arm = blown()
    wires = {"solid.grip": "arm.bar_pose", "arm.bar_reaction": "solid.grip_wrench"}
    port = "solid.air_pressure"
    network = systems.Network({"arm": arm, "solid": solid}, wires, (port,))
    want, still = (
        systems.simulate(network, 0.05, inputs={port: p}, step=1.25e-4, save=5).state["arm"][
            "q"
        ]
        for p in (5e3, 0.0)
    )
    small = systems.modal_body(solid, systems.modal_basis(solid, 8))
    bare = systems.AssemblyBody(arm.assembly, arm.forces)
    port = "arm.bar_air_pressure"
    network = systems.Network({"arm": systems.CarryingBody(bare, {"bar": small})}, {}, (port,))
    film = systems.simulate(network, 0.05, inputs={port: 5e3}, solver=METHOD, step=5e-4, save=5)
    off = jnp.max(jnp.abs(film.state["arm"]["q"] - want))
    assert off < 0.05 * jnp.max(jnp.abs(want - still))


def test_a_chamber_that_is_open_where_a_link_holds_it_is_refused():
    with pytest.raises(ValueError, match="open end at nodes .* which a driven support moves"):
        blown(closed=False)


def _with(solid, load) -> fem.Problem:
    loads = (*solid.problem.loads, load)
    return eqx.tree_at(lambda p: p.loads, solid.problem, loads)


def test_the_derivative_goes_through_link_and_shapes():
    base = reduced(1.0, modulus=3e5)

    first = base.blocks["arm"].solids["bar"].inertia.first

    def angle(farther):
        moved = farther * first
        network = replace(base, lambda n: n.blocks["arm"].solids["bar"].inertia.first, moved)
        film = systems.simulate(network, 0.02, solver=METHOD, step=1e-3, save=2)
        return film.state["arm"]["q"][-1, 0] + 0.01 * film.state["arm"]["v"][-1, 0]

    both = jax.jit(jax.value_and_grad(angle))
    h = 1e-3
    values = np.asarray([both(1.0 + k * h)[0] for k in (-2, -1, 1, 2)])
    slope = values @ [1, -8, 8, -1] / (12 * h)
    assert abs(slope) > 1e-4 and np.isclose(both(1.0)[1], slope, rtol=1e-7, atol=0)


def _pinned(solid):
    supports = (*solid.problem.supports, fem.Fixed([0]))
    return eqx.tree_at(lambda b: b.problem.supports, solid, supports)


def _forced(solid):
    return systems.FemBody(_with(solid, fem.Force([1], [0.0, 1.0])), driven=("grip",))


def _begun(solid):
    return replace(solid, lambda b: b.u, jnp.zeros_like(solid.problem.mesh.points))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_pinned, "one fem.Carried alone"),
        (_forced, "need weight, and driven pressures"),
        (_begun, "begins at rest in its frame"),
    ],
)
def test_what_a_frame_cannot_carry_is_refused(change, says):
    solid = change(pendulum(1.0).blocks["solid"])
    with pytest.raises(ValueError, match=says):
        systems.modal_body(solid, systems.modal_basis(solid, 1, bending=False))


def test_solids_are_carried_by_links_and_links_alone_move_them():
    network = reduced(1.0)
    solid, arm = network.blocks["arm"].solids["bar"], network.blocks["arm"].arm
    with pytest.raises(ValueError, match="Put systems.CarryingBody"):
        systems.simulate(systems.Network({"solid": solid}, {}), 0.1)
    free = replace(solid, lambda b: b.inertia, None)
    with pytest.raises(ValueError, match="the solid on `bar` is fixed to the ground"):
        systems.CarryingBody(arm, {"bar": free})
    held = rod.with_closures(arm.assembly, bar=rod.Closure("bar", rod.Revolute()))
    with pytest.raises(ValueError, match="bar_wrench is the name of two ports or states"):
        systems.CarryingBody(systems.AssemblyBody(held), {"bar": solid})
    finger = rod.rod(
        SE2(), rod.chebyshev(kappa_z=2), rod.circle(5e-3), length=0.1, young_modulus=1e6,
        poisson_ratio=0.5, density=1000,
    )  # fmt: skip
    soft = systems.AssemblyBody(rod.assembly(SE2(), bar=rod.Part(finger)))
    with pytest.raises(ValueError, match="`bar` is a rod, need a link"):
        systems.CarryingBody(soft, {"bar": solid})
