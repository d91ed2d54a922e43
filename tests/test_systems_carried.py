"""A solid on a link of a mechanism: the pose of the link in, its reaction out, in one step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, Status, fem, material, mesh, replace, rod, systems
from tests.test_fem_supports import SHARP

G = 9.81
LENGTH, WIDTH, ARM = 0.04, 0.02, 0.06  # of the solid; from the hinge to the solid [m]


def pendulum(ratio, modulus=1e7) -> Any:
    """A link on a hinge, horizontal at first, that carries a solid `ratio` times as heavy."""
    cells = mesh.rectangle(
        [ARM, -WIDTH / 2], [ARM + LENGTH, WIDTH / 2], divisions=(2, 1), element=mesh.Quad8()
    )
    left = cells.node_sets["left"]
    grip = fem.Carried(left, cells.points[left], name="grip")
    rubber = material.neo_hookean(young_modulus=modulus, poisson_ratio=0.3, density=1000.0)
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(0.02),
        supports=(grip,),
        loads=(fem.Gravity([0.0, -G]),),
    )
    mass = fem.total_mass(problem) / ratio
    link = rod.Link(mass, mass * ARM**2 / 12, [ARM / 2, 0.0])
    arm = rod.assembly(SE2(), bar=rod.Part(link, rod.Revolute()))
    blocks = {
        "arm": systems.AssemblyBody(arm, (rod.Gravity([0.0, -G]),), carrying=("bar",)),
        "solid": systems.FemBody(problem, driven=("grip",), energies=True),
    }
    wires = {"solid.grip": "arm.bar_pose", "arm.bar_reaction": "solid.grip_wrench"}
    return systems.Network(blocks, wires)


def compound(ratio, times):
    """Angle of the rigid whole: I a = -W cos(angle), by many small steps."""
    solid = 1000.0 * LENGTH * WIDTH * 0.02
    link = solid / ratio
    centre = ARM + LENGTH / 2
    inertia = solid * ((LENGTH**2 + WIDTH**2) / 12 + centre**2) + link * ARM**2 / 3
    weight = G * (solid * centre + link * ARM / 2)

    def rate(y):
        return np.array([y[1], -weight / inertia * np.cos(y[0])])

    y, found, n = np.zeros(2), [0.0], 200
    for h in np.diff(times):
        for _ in range(n):
            k = h / n
            a = rate(y)
            b = rate(y + k / 2 * a)
            c = rate(y + k / 2 * b)
            d = rate(y + k * c)
            y = y + k / 6 * (a + 2 * b + 2 * c + d)
        found.append(y[0])
    return np.array(found)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_a_stiff_solid_on_a_link_swings_as_one_rigid_pendulum(ratio):
    network, errors = pendulum(ratio), []
    for step in (4e-3, 2e-3):
        film = systems.simulate(network, 0.4, step=step, save=11)
        assert film.status == Status.successful
        want = compound(ratio, np.asarray(film.time))
        errors.append(np.abs(np.asarray(film.state["arm"]["q"][:, 0]) - want).max())
    assert errors[1] < 5e-3 and errors[0] / errors[1] > 2.5


def test_link_and_solid_keep_their_energy():
    """A soft solid is shaken by its own weight; the method damps what its steps do not
    resolve, and gives nothing."""
    network = pendulum(1.0, modulus=3e5)
    film = systems.simulate(network, 0.2, step=1e-3, save=41)
    problem = network.blocks["solid"].problem
    link = network.blocks["arm"].assembly.parts[0].body
    angle, rate = film.state["arm"]["q"][:, 0], film.state["arm"]["v"][:, 0]
    height = ARM / 2 * jnp.sin(angle)
    inertia = link.inertia + link.mass * (ARM / 2) ** 2
    of_link = inertia * rate**2 / 2 + link.mass * G * height
    weight = jax.vmap(lambda u: problem.loads[0].potential(problem, u))(
        film.state["solid"]["u"]
    )
    moving, bent = (film.outputs[f"solid.{kind}_energy"] for kind in ("kinetic", "elastic"))
    total = of_link + weight + moving + bent
    size = float(jnp.max(moving))
    assert float(jnp.max(bent)) > 1e-3 * size
    assert jnp.max(jnp.abs(total - total[0])) < 0.01 * size


@pytest.mark.slow
def test_the_derivative_goes_through_link_and_solid():
    base = pendulum(1.0, modulus=3e5)

    def angle(stiffer):
        rubber = jax.tree.map(lambda x: x * stiffer, base.blocks["solid"].problem.material)
        moved = replace(base, lambda n: n.blocks["solid"].problem.material, rubber)
        film = systems.simulate(moved, 0.02, step=4e-3, save=2)
        return film.state["arm"]["q"][-1, 0] + 0.01 * film.state["arm"]["v"][-1, 0]

    both = jax.jit(jax.value_and_grad(angle))  # one program for values and slopes
    h = 1e-3
    values = np.asarray([both(1.0 + k * h)[0] for k in (-2, -1, 1, 2)])
    assert np.isclose(both(1.0)[1], values @ [1, -8, 8, -1] / (12 * h), rtol=1e-7, atol=0)


@pytest.mark.parametrize("element", [mesh.Quad4(), mesh.Hex8()], ids=lambda e: e.name)
def test_the_wrench_of_a_carried_solid_is_that_of_its_reactions(element):
    """A solid whose frame has turned, not about the origin of the mesh, and that is heavy."""
    dim = element.dim
    make: Any = mesh.rectangle if dim == 2 else mesh.box
    size = [0.02, 0.01, 0.01][:dim]
    cells = make([0.0] * dim, size, divisions=(2, 1, 1)[:dim], element=element)
    turn = np.eye(dim)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    rest, pose = np.eye(dim + 1), np.eye(dim + 1)
    rest[:dim, -1] = [0.005, -0.01, 0.02][:dim]
    pose[:dim, :dim], pose[:dim, -1] = turn, [0.01, 0.02, 0.03][:dim]
    left = cells.node_sets["left"]
    grip = fem.Carried(left, cells.points[left], (pose - rest)[:-1], rest, name="grip")
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0)
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(0.01) if dim == 2 else None,
        supports=(grip,),
        loads=(fem.Gravity([0.3, -9.0, 2.0][:dim]),),
    )
    u = fem.solve(problem, newton=SHARP).displacement
    inside = (cells.points[left] - rest[None, :dim, -1]) @ turn.T + pose[None, :dim, -1]
    np.testing.assert_allclose((cells.points + u)[left], inside, atol=1e-15)
    body = systems.FemBody(problem, driven=("grip",), u=u)
    start = body.initial_state()
    got = body.output("grip_wrench", jnp.zeros(()), start, {})
    found = fem.reactions(problem, u, about=pose[:dim, -1])["grip"]
    want = jnp.concatenate([found.moment, found.force])
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * float(jnp.max(jnp.abs(want))))
    assert body.outputs["grip_wrench"].shape == want.shape


def test_a_solid_that_begins_beside_its_link_is_named():
    base = pendulum(1.0)
    arm = base.blocks["arm"]
    turned = systems.AssemblyBody(arm.assembly, arm.forces, q=[0.5], carrying=("bar",))
    apart = systems.Network({**base.blocks, "arm": turned}, base.wires)
    with pytest.raises(ValueError, match="`solid` with nodes 30 mm from where"):
        systems.simulate(apart, 0.01, step=2e-3)
