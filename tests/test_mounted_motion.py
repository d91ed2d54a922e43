"""A rod on the face of a solid in motion: as one assembly, one beam, and in networks."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, SE3, Status, coupling, fem, material, math, mesh, rod, systems
from tests.test_fem_supports import SHARP

SIZE, LENGTH, RADIUS = 0.02, 0.06, 3e-3  # of the block; of the rod [m]
ROD_MASS = 1000.0 * np.pi * RADIUS**2 * LENGTH


def whisker(group, basis, young=2e5, density=1000.0):
    return rod.rod(
        group,
        basis,
        rod.circle(RADIUS),
        length=LENGTH,
        young_modulus=young,
        poisson_ratio=0.45,
        density=density,
    )


def on_block(dim, ratio, modulus, *, held=False, density=1000.0, **options) -> Any:
    """A block with a rod `ratio` times as heavy, the rod and the base."""
    if dim == 2:
        block = mesh.rectangle([-SIZE / 2] * 2, [SIZE / 2] * 2, divisions=(1, 1), order=2)
        one = whisker(SE2(), rod.chebyshev(kappa_z=3), density=density)
    else:
        block = mesh.box([-SIZE / 2] * 3, [SIZE / 2] * 3, divisions=(1, 1, 1))
        one = whisker(SE3(), rod.chebyshev(kappa_y=2, kappa_z=2), density=density)
    base = np.eye(dim + 1)
    base[0, -1] = SIZE / 2
    cells, load = coupling.mounted_rod(block, one, block.node_sets["right"], base, **options)
    rubber = material.neo_hookean(
        young_modulus=modulus, poisson_ratio=0.3, density=ROD_MASS / ratio / SIZE**3
    )
    supports = (fem.Fixed(block.node_sets["left"]),) if held else ()
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(SIZE) if dim == 2 else None,
        supports=supports,
        loads=(load,),
        free=not held,
    )
    return problem, one, base


def total(motion):
    energies = motion.energies
    return energies.kinetic + energies.elastic + energies.loads


@pytest.mark.parametrize(
    "dim,ratio", [(2, 0.1), (2, 10.0), pytest.param(3, 1.0, marks=pytest.mark.slow)]
)
def test_a_rod_on_a_hard_block_in_flight_moves_as_their_assembly(dim, ratio):
    """They tumble three quarters of a turn in the plane; the rod lags and swings."""
    problem, one, base = on_block(dim, ratio, 1e7)
    spin = np.array([30.0]) if dim == 2 else np.array([8.0, -12.0, 30.0])
    speed, mass = np.array([0.3, -0.2, 0.1])[:dim], ROD_MASS / ratio
    turns: Any = mass * SIZE**2 / 6 * (1.0 if dim == 2 else np.eye(3))
    parts = {
        "block": rod.Part(rod.Link(mass, turns), rod.Free()),
        "rod": rod.Part(one, on="block", offset=base),
    }
    model = rod.assembly(one.group, **parts)
    v = jnp.zeros(rod.num_dof(model)).at[: len(spin) + dim].set(np.append(spin, speed))
    want = rod.rollout(
        model, rod.rest(model), v, step=5e-5, saves=4, every=400, stepper=math.RungeKutta4()
    )
    tips = jax.vmap(lambda q: rod.tip_pose(model, q)["rod"][:-1, -1])(want.q)
    X = np.asarray(problem.mesh.points)
    swept = np.stack([-X[:, 1], X[:, 0]], 1) * spin[0] if dim == 2 else np.cross(spin, X)
    start = (speed + swept) * np.asarray(X[:, :1] < 0.6 * SIZE)
    start[np.asarray(problem.loads[0].places)] = 0.0
    np.testing.assert_allclose(fem.total_mass(problem), ROD_MASS + mass, rtol=1e-12)
    errors, kept = [], []
    for step in (1e-3, 5e-4):
        motion = fem.simulate(
            problem, 0.08, step, start=(jnp.asarray(0 * X), jnp.asarray(start)), save=5
        )
        found = jax.vmap(lambda u: coupling.mount_wrench(problem, u).tip[:-1, -1])
        errors.append(float(jnp.max(jnp.abs(found(motion.displacements) - tips))))
        energy, (linear, angular) = total(motion), fem.momentum(motion)
        assert jnp.max(jnp.abs(energy / energy[0] - 1)) < 2e-3
        moved = [jnp.max(jnp.abs(p - p[:1])) / jnp.max(jnp.abs(p)) for p in (linear, angular)]
        kept.append(float(max(moved)))
    assert errors[1] < 3e-5 and 3.5 < errors[0] / errors[1] < 4.5
    assert kept[1] < 1e-4 and kept[0] / kept[1] > 3.5
    first = rod.momentum(model, rod.rest(model), v)
    np.testing.assert_allclose(linear[0], first[-dim:], rtol=1e-9)
    np.testing.assert_allclose(angular[0], first[:-dim], rtol=1e-9)


def test_a_rod_that_continues_a_beam_has_the_frequencies_of_the_whole():
    """A solid of 12 x 1 and a rod of the same section, against the solid of twice the length;
    the Young's modulus of the rod is that of plane strain."""
    deep, long = 0.01, 0.12
    young, nu = 1e6, 0.3
    rubber = material.neo_hookean(young_modulus=young, poisson_ratio=nu, density=1000.0)

    def beam(length, divisions):
        return mesh.rectangle([0, 0], [length, deep], divisions=divisions, order=2)

    plane, half = fem.PlaneStrain(deep), beam(long, (12, 2))
    base = np.array([[1, 0, long], [0, 1, deep / 2], [0, 0, 1.0]])
    one = rod.rod(
        SE2(),
        rod.chebyshev(kappa_z=4, sigma_y=2),
        rod.rectangle(deep, deep),
        length=long,
        young_modulus=young / (1 - nu**2),
        poisson_ratio=nu,
        density=1000.0,
    )
    cells, load = coupling.mounted_rod(half, one, half.node_sets["right"], base)
    both, whole = (
        fem.problem(
            x, rubber, kinematics=plane, supports=(fem.Fixed(x.node_sets["left"]),), loads=y
        )
        for x, y in ((cells, (load,)), (beam(2 * long, (24, 2)), ()))
    )
    found, want = (jnp.sqrt(fem.eigenmodes(x, count=2).eigenvalues) for x in (both, whole))
    np.testing.assert_allclose(found, want, rtol=0.01)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_a_soft_block_and_its_rod_keep_their_energy(ratio):
    problem, _, _ = on_block(2, ratio, 3e4, held=True, gravity=[0.0, -9.81])
    motion = fem.simulate(problem, 0.4, 1e-3, save=41)
    energy, size = total(motion), float(jnp.max(motion.energies.kinetic))
    assert float(jnp.max(motion.energies.elastic)) > 1e-3 * size
    assert jnp.max(jnp.abs(energy - energy[0])) < 1e-3 * size
    # work is counted where forces act: of second order where that is the middle of a step
    even = fem.simulate(problem, 0.4, 1e-3, save=41, method=fem.GeneralisedAlpha(1.0))
    for kept in (total(even), even.energies.balance):
        assert jnp.max(jnp.abs(kept - kept[0])) < 0.01 * size


def test_supports_bear_weight_and_inertia_of_the_rod():
    """The rate of the momentum is the reaction plus the weight."""
    gravity = np.array([0.0, -9.81])
    problem, _, _ = on_block(2, 1.0, 3e4, held=True, gravity=gravity)
    motion = fem.simulate(problem, 0.02, 2.5e-4, method=fem.Newmark())
    found = fem.reaction_history(motion)["fixed"].force
    linear = fem.momentum(motion)[0]
    rate = (linear[2:] - linear[:-2]) / 5e-4
    weight = ROD_MASS * gravity
    assert float(jnp.max(jnp.abs(rate))) > 0.5 * abs(weight[1])
    np.testing.assert_allclose(found[1:-1], rate - weight[None], atol=0.01 * abs(weight[1]))


def test_a_network_moves_block_and_rod_as_fem_does():
    problem, _, _ = on_block(2, 3.0, 3e4, held=True, value=[0.0, 0.01])
    start = fem.simulate(problem, 0.02, 1e-3).end
    u, v = start.displacement, start.velocity
    body = systems.FemBody(problem, driven=("rod",), u=u, v=v, energies=True)
    network = systems.Network({"body": body}, {}, exposed=("body.rod",))
    pull = {"body.rod": lambda t: jnp.stack([0 * t, 0.01 - t])}
    film = systems.simulate(network, 0.02, step=1e-3, save=21, inputs=pull)
    assert film.status == Status.successful
    rows = jax.vmap(pull["body.rod"])(jnp.linspace(0, 0.02, 21))
    motion = fem.simulate(problem, 0.02, 1e-3, start=(u, v), rod=rows)
    size = float(jnp.max(jnp.abs(motion.displacements)))
    np.testing.assert_allclose(
        film.state["body"]["u"], motion.displacements, rtol=0, atol=1e-6 * size
    )
    kinetic = motion.energies.kinetic
    np.testing.assert_allclose(film.outputs["body.kinetic_energy"], kinetic, rtol=1e-5)


@pytest.mark.slow
def test_a_rod_on_a_link_without_mass_that_carries_the_face_moves_alike():
    """The way for rods with other forces; the face is then rigid, as it is on a hard block."""
    problem, one, base = on_block(2, 10.0, 1e7, held=True, gravity=[0.0, -9.81])
    motion = fem.simulate(problem, 0.05, 1e-3, save=6)
    find = jax.vmap(lambda u: coupling.mount_wrench(problem, u).tip[:-1, -1])
    want = find(motion.displacements)
    block = mesh.rectangle([-SIZE / 2] * 2, [SIZE / 2] * 2, divisions=(1, 1), order=2)
    right = block.node_sets["right"]
    face = fem.Carried(right, block.points[right], rest=base, name="face")
    supports = (fem.Fixed(block.node_sets["left"]), face)
    plane, rubber = problem.kinematics, problem.material
    solid = fem.problem(block, rubber, kinematics=plane, supports=supports)
    foot = rod.Part(rod.Link(0.0, 0.0), rod.Free(), offset=base)
    model = rod.assembly(SE2(), foot=foot, rod=rod.Part(one, on="foot"))
    weight = (rod.Gravity([0.0, -9.81]),)
    network = systems.Network(
        {
            "rod": systems.AssemblyBody(model, weight, carrying=("foot",)),
            "solid": systems.FemBody(solid, driven=("face",)),
        },
        {"solid.face": "rod.foot_pose", "rod.foot_reaction": "solid.face_wrench"},
    )
    film = systems.simulate(network, 0.05, step=1e-3, save=6)
    assert film.status == Status.successful
    found, size = film.outputs["rod.rod_position"], jnp.max(jnp.abs(want - want[:1]))
    assert jnp.max(jnp.abs(found - want)) < 2e-3 * size


@pytest.mark.slow
def test_slopes_of_a_motion_are_those_of_its_values():
    given, _, _ = on_block(2, 1.0, 3e4, held=True)
    still = jnp.zeros_like(given.mesh.points)

    def end(numbers):
        modulus, density, speed = numbers
        problem = eqx.tree_at(
            lambda p: (p.material.shear_modulus, p.loads[0].rod.material.density),
            given,
            (modulus, density),
        )
        start = still, still.at[given.loads[0].places[0], 0].set(speed)
        motion = fem.simulate(problem, 0.01, 2e-3, start=start, newton=SHARP)
        return 1e3 * coupling.mount_wrench(problem, motion.end.displacement).tip[1, 2]

    at = jnp.array([1e4, 1200.0, 0.3])
    end, slope = jax.jit(end), jax.jit(jax.grad(end))(at)
    for k, size in enumerate(np.asarray(at)):
        step = 1e-3 * size * np.eye(3)[k]
        values = [float(end(at + s * step)) for s in (-2, -1, 1, 2)]
        want = np.dot(values, [1, -8, 8, -1]) / (12e-3 * size)
        assert float(slope[k]) == pytest.approx(want, rel=1e-6)
