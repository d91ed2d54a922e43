"""Finite-element bodies in networks: with gas, against what they must equal, and reduced."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material, mesh, systems as S
from sorojax.math.linalg import sparse
from sorojax.math.status import Status
from sorojax.robots import BellowsActuator

ATMOSPHERE = 101325.0
GRID = mesh.rectangle([5e-3, 0], [8e-3, 4e-3], divisions=(2, 1), order=2)
SPACE = fem.space(GRID)
WIRES = {
    "tube.pressure": "air.pressure",
    "air.volume": "tube.volume",
    "air.volume_rate": "tube.volume_rate",
}


def tube_problem(modulus):
    rubber = material.neo_hookean(young_modulus=modulus, poisson_ratio=0.45, density=1000.0)
    return fem.problem(
        GRID,
        rubber,
        kinematics=fem.Axisymmetric(),
        space=SPACE,
        supports=(
            fem.Fixed(GRID.node_sets["bottom"], (1,)),
            fem.Fixed(GRID.node_sets["top"], (1,)),
        ),
        loads=(fem.Pressure(GRID.facet_sets["left"]),),
    )


def tube(modulus=1e6, damping=0.0, speed=0.0):
    """A length of a rubber tube between two plates, four cells, that breathes at `speed`."""
    corner = mesh.nearest_node(GRID, (8e-3, 0.0))
    return S.FemBody(
        tube_problem(modulus),
        fem.Rayleigh(damping),
        markers={"skin": corner},
        u=jnp.zeros_like(GRID.points),
        v=speed * _breathing(),
        energies=True,
    )


@functools.cache
def _breathing():
    """The first mode, of unit size: faster ones would ask for shorter steps."""
    shape = fem.eigenmodes(tube_problem(1e6), count=1).shapes[0]
    return shape / jnp.max(jnp.abs(shape))


def sealed(pressure=0.0, **options):
    """The tube with gas that keeps its mass."""
    blocks = {"tube": tube(**options), "air": S.Reservoir(start_pressure=pressure)}
    return S.Network(blocks, WIRES)


STEPS, SAVE = 80, 5


def run(network, duration, **options):
    """80 steps, whatever they are: one compiled program for all numbers."""
    return S.simulate(network, duration, save=SAVE, step=duration / STEPS, **options)


@pytest.fixture(scope="module")
def breath():
    """The tube breathing with its gas, in steps of 5 us and of 2.5 us."""
    return run(sealed(speed=3.0), 4e-4), run(sealed(speed=3.0), 2e-4)


def test_a_body_with_gas_moves_as_its_differential_equations_say(breath):
    """Against the same network as ordinary differential equations, with an explicit method."""
    exact = S.simulate(sealed(speed=3.0), 2e-4, save=3, rtol=1e-7, atol=1e-10)
    errors = []
    for film, number in zip(breath, (2, 4), strict=True):
        for port in ("air.pressure", "tube.skin_position"):
            missed = film[port][number] - exact[port][-1]
            change = exact[port][-1] - exact[port][0]
            errors.append(float(jnp.max(jnp.abs(missed)) / jnp.max(jnp.abs(change))))
    coarse, fine = max(errors[:2]), max(errors[2:])
    assert fine < 2e-4 and coarse > 2 * fine, errors


def test_gas_and_body_exchange_no_more_than_there_is(breath):
    """What the body has more the gas has less, p V being constant."""
    left = []
    for film in breath:
        absolute, volume = film["air.pressure"] + ATMOSPHERE, film["tube.volume"]
        product = absolute * volume
        assert jnp.allclose(product, product[0], rtol=1e-9)
        given = product * jnp.log(volume / volume[0]) - ATMOSPHERE * (volume - volume[0])
        has = film["tube.kinetic_energy"] + film["tube.elastic_energy"]
        change = has - has[0] + film["tube.dissipated"] - given
        left.append(float(jnp.abs(change[2]) / jnp.max(jnp.abs(given))))
        own = film["tube.work"] - film["tube.dissipated"]  # as the steps take it
        assert jnp.allclose(has - has[0], own, atol=0.02 * float(jnp.max(jnp.abs(given))))
    assert left[0] < 1e-3, left


def test_a_damped_body_comes_to_the_equilibrium_with_its_gas():
    """Against the static solver of closed cavities, which knows nothing of networks."""
    network = sealed(20e3, damping=3e3)
    film = run(network, 0.08)
    assert film.status == Status.successful
    start = film["tube.volume"][0]
    filled = fem.Gas(start, pressure=20e3, ambient=ATMOSPHERE)
    found = fem.solve_volume(network.blocks["tube"].problem, pressure=filled)
    assert jnp.isclose(film["air.pressure"][-1], found.pressures[0], rtol=1e-6)
    assert jnp.isclose(film["tube.volume"][-1], found.volumes[0], rtol=1e-8)


def test_a_step_that_cannot_converge_is_cut_and_then_held():
    film = run(sealed(pressure=1e12), 4e-4, throw=False)
    assert film.status == Status.not_converged and float(film.stats["reached"]) == 0.0
    assert all(jnp.array_equal(x[0], x[-1]) for x in film.state["tube"].values())
    with pytest.raises(RuntimeError, match="stopped after 0 s"):
        run(sealed(pressure=1e12), 4e-4)


@pytest.mark.slow
def test_two_halves_give_the_bits_of_the_whole(breath):
    """The acceleration of the method goes on with the state."""
    whole, half = breath[1], {"save": 3, "step": 2e-4 / STEPS}
    first = S.simulate(sealed(speed=3.0), 1e-4, **half)
    second = S.simulate(sealed(speed=3.0), 1e-4, resume=first, **half)
    for a, b in ((first, whole.outputs), (second, whole.outputs)):
        part = slice(0, 3) if a is first else slice(2, 5)
        assert all(jnp.array_equal(x, b[name][part]) for name, x in a.outputs.items())


@pytest.mark.slow
def test_gradients_agree_with_differences():
    _breathing()  # outside of what is compiled

    def pressure(scale):
        network = sealed(speed=3.0 * scale[0], modulus=1e6 * scale[1])
        film = S.simulate(network, 2e-4, save=2, step=2.5e-5)
        return film["air.pressure"][-1] / 1e3

    one, h = jnp.ones(2), 1e-3
    both = jax.jit(jax.value_and_grad(pressure))  # one program for values and slopes
    steps = [both(one + k * h * row)[0] for row in jnp.eye(2) for k in (-2, -1, 1, 2)]
    differences = np.asarray(steps).reshape(2, 4) @ np.array([1, -8, 8, -1]) / (12 * h)
    assert np.allclose(both(one)[1], differences, rtol=1e-6)


def test_names_and_densities_are_checked():
    plain = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
    problem = eqx.tree_at(lambda p: p.material, tube().problem, plain)
    with pytest.raises(ValueError, match="no density"):
        S.FemBody(problem)
    with pytest.raises(ValueError, match="names 0 loads"):
        S.FemBody(tube().problem, driven=("water",))
    network = S.Network({"air": S.Reservoir(volume=1e-4)}, {})
    with pytest.raises(ValueError, match="FemBody"):
        S.simulate(network, 1.0, step=0.1, solver=S.Coupled())


# Reduced


@pytest.fixture(scope="module")
def basis():
    return S.modal_basis(tube(), 2)


def test_shapes_are_orthonormal_in_the_mass_and_hold_the_answer_to_a_load(basis):
    body = tube()
    mass = body.matter().mass
    rows = basis.shapes.reshape(len(basis), -1)
    weighed = jax.vmap(lambda x: sparse.product(SPACE.system, mass, x))(rows)
    assert jnp.allclose(rows @ weighed.T, jnp.eye(len(basis)), atol=1e-9)
    small = eqx.tree_at(lambda p: p.loads[0].value, body.problem, jnp.asarray(1e-3))
    answer = fem.solve(small).displacement.ravel()
    left = answer - (weighed @ answer) @ rows
    assert jnp.linalg.norm(left) < 1e-6 * jnp.linalg.norm(answer)


def test_a_reduced_body_has_the_volumes_and_forces_of_the_full_one(basis):
    full, small = tube(), S.modal_body(tube(), basis)
    exact = S.modal_body(tube(), basis, order=None)
    way = jnp.linspace(1.0, -1.0, len(basis)) * 1e-7
    errors = []
    for q in (way, 2 * way):
        state = {"u": S.displacement(basis, q), "v": jnp.zeros_like(GRID.points)}
        reduced_state = {"q": q, "v": jnp.zeros_like(q)}
        wanted = full.output("volume", 0.0, state, {})
        assert jnp.isclose(small.output("volume", 0.0, reduced_state, {}), wanted, rtol=1e-13)
        errors.append(jnp.linalg.norm(small.force(q) - exact.force(q)))
        slope = jax.grad(small.force.energy)(q)
        assert jnp.allclose(slope, small.force(q), rtol=1e-9, atol=1e-9 * jnp.abs(slope).max())
    assert 12 < errors[1] / errors[0] < 20  # what is left out is of fourth order
    frequency = fem.eigenmodes(tube_problem(1e6), count=1).frequencies[0]
    stiffness = jax.jacfwd(small.force)(jnp.zeros(len(basis)))
    assert jnp.isclose(jnp.sqrt(stiffness[0, 0]) / (2 * jnp.pi), frequency, rtol=1e-9)


def test_a_reduced_body_breathes_like_the_full_one(basis, breath):
    """The volume that the full one changes by, to one percent in a polynomial of order 3, which
    is better than that of order 1."""
    film = breath[0]
    change = jnp.max(jnp.abs(film["tube.volume"] - film["tube.volume"][0]))
    missed = []
    for order in (1, 3):
        small = S.modal_body(tube(speed=3.0), basis, order=order)
        network = S.Network({"tube": small, "air": S.Reservoir()}, WIRES)
        found = S.simulate(network, 4e-4, save=SAVE, rtol=1e-7, atol=1e-10)
        missed.append(jnp.max(jnp.abs(found["tube.volume"] - film["tube.volume"])) / change)
    assert missed[1] < 0.01 and missed[0] > 2 * missed[1], missed


def test_a_body_at_rest_stays_there():
    """Rounding of the stresses at rest does not move it."""
    film = run(S.Network({"tube": tube()}, {}), 4e-4)
    assert film.status == Status.successful
    place = np.asarray(film["tube.skin_position"])
    assert np.all(place == place[0])


def test_the_tendon_of_a_reduced_body_does_not_push():
    pulled = fem.Tendon(fem.route(GRID, np.array([[5e-3, 2e-3], [8e-3, 2e-3]])))
    held = (fem.Fixed(GRID.node_sets["bottom"], (1,)),)
    problem = fem.problem(
        GRID,
        tube_problem(1e6).material,
        kinematics=fem.Axisymmetric(),
        supports=held,
        loads=(pulled,),
    )
    body = S.FemBody(problem, driven=("tendon",))
    small = S.modal_body(body, S.modal_basis(body, 1, bending=False), order=1)
    rest = small.initial_state()
    pull, push, none = (
        small.vector_field(0.0, rest, {"tendon": jnp.asarray(value)})["v"]
        for value in (1.0, -1.0, 0.0)
    )
    assert jnp.max(jnp.abs(pull - none)) > 1e-3 and jnp.array_equal(push, none)


# A soft actuator


def bellows():
    """Two bellows on their layer, coarse, with air and a regulator."""
    actuator = BellowsActuator(num_bellows=2)
    cells = mesh.triangulate(actuator.body(), size=2e-3, order=2)
    rubber = material.NeoHookean(4e5, 4e6, density=1080.0)
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(20e-3),
        supports=(fem.Fixed(mesh.nodes_where(cells, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(mesh.facets_on(cells, actuator.chambers()), name="air"),),
    )
    tip = mesh.nearest_node(cells, (float(actuator.length), 0.0))
    return S.FemBody(problem, fem.Rayleigh(5.0, 1e-3), markers={"tip": tip})


def test_a_body_that_nothing_drives_moves_as_alone():
    bar = mesh.rectangle([0, 0], [0.04, 0.01], divisions=(3, 1))
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0)
    problem = fem.problem(
        bar,
        rubber,
        kinematics=fem.PlaneStrain(0.01),
        supports=(fem.Fixed(bar.node_sets["left"]),),
        loads=(fem.Gravity((0.0, -9.81)),),
    )
    tip = int(bar.node_sets["right"][0])
    network = S.Network({"bar": S.FemBody(problem, markers={"tip": tip})}, {})
    film = S.simulate(network, 0.01, step=1e-3, save=2)
    alone = fem.simulate(problem, 0.01, 1e-3, method=fem.GeneralisedAlpha(0.5))
    moved = film["bar.tip_position"][-1] - bar.points[tip]
    assert moved[1] < -1e-4
    assert jnp.allclose(
        moved, alone.displacements[-1, tip], rtol=0, atol=1e-4 * jnp.abs(moved[1])
    )


@pytest.mark.slow
def test_a_regulated_bellows_reaches_its_pressure_and_the_place_of_statics():
    body = bellows()
    blocks = {
        "body": body,
        "air": S.Reservoir(),
        "valve": S.Regulator(1e-9, 1e-8),
        "goal": S.Source(S.SmoothRamp([0.0, 0.1], [0.0, 8e3]), unit="Pa"),
    }
    wires = {
        "body.air_pressure": "air.pressure",
        "air.volume": "body.air_volume",
        "air.volume_rate": "body.air_volume_rate",
        "air.mass_flow": "valve.mass_flow",
        "valve.pressure": "air.pressure",
        "valve.setpoint": "goal.value",
    }
    film = S.simulate(S.Network(blocks, wires), 0.8, save=9, step=4e-3)
    assert film.status == Status.successful
    assert jnp.isclose(film["air.pressure"][-1], 8e3, rtol=1e-3)
    still = fem.solve(fem.with_load(body.problem, "air", film["air.pressure"][-1]))
    (_, node), *_ = body.markers
    moved = still.displacement[node]
    missed = film["body.tip_position"][-1] - film["body.tip_position"][0] - moved
    assert jnp.linalg.norm(moved) > 1e-3
    assert jnp.linalg.norm(missed) < 5e-3 * jnp.linalg.norm(moved)
