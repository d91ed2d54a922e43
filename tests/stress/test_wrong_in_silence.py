"""Answers that are wrong say so: runs, rods and gas outside what their models describe."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, systems as S
from sorojax.math.lie import SE2
from sorojax.math.ode import steppers
from sorojax.math.status import Status

SOFT = {"length": 0.1, "young_modulus": 1e5, "poisson_ratio": 0.45, "density": 1000.0}
EA = 1e5 * float(R.circle(10e-3).area)


def vessel(volume=1e-4, target=3e3, **regulator) -> S.Network:
    blocks = {
        "target": S.Source(S.Constant(target), unit="Pa"),
        "valve": S.Regulator(**regulator),
        "air": S.Reservoir(volume=volume),
    }
    wires = {
        "valve.setpoint": "target.value",
        "valve.pressure": "air.pressure",
        "air.mass_flow": "valve.mass_flow",
    }
    return S.Network(blocks, wires)


def finger(nodes=6, **modes) -> R.Rod:
    return R.rod(
        SE2(), R.chebyshev(**(modes or {"kappa_z": 2})), R.circle(10e-3), nodes=nodes, **SOFT
    )


@pytest.mark.stress(81)
@pytest.mark.parametrize(
    "save, step, good", [(21, 0.05, False), (3, 0.05, False), (201, 1e-4, True)]
)
def test_a_network_beyond_stability_says_so(save, step, good):
    net = vessel(proportional=1e-5, integral_gain=1e-7, max_flow=1e3)
    film = S.simulate(net, 1.0, save=save, step=step, throw=False)
    right = float(jnp.abs(film["air.pressure"] - 3e3)[-1]) < 30.0
    assert right == good and (film.status == Status.successful) == good


@pytest.mark.stress(82)
@pytest.mark.parametrize(
    "stepper, share, status",
    [
        (steppers.RungeKutta4(), 2.1, "unstable"),
        (steppers.DormandPrince(), 2.05, "unstable"),
        (steppers.RungeKutta4(), 5.0, "not_finite"),
        (steppers.DormandPrince(), 5.0, "not_finite"),
        (steppers.RungeKutta4(), 0.2, "successful"),
        (steppers.DormandPrince(), 0.2, "successful"),
    ],
)
def test_a_rod_beyond_stability_says_so(stepper, share, status):
    """Steps of `share` times 1.4 over the fastest frequency; the first of these ends at q =
    (-14, -4), finite and bounded, where (-10, 15) is right."""
    rod, rest = finger(), jnp.zeros(2)
    weight = (R.Gravity((0.0, -9.81)),)
    mass = R.inertia(R.motion(rod, rest))[0]
    squares = jnp.linalg.eigvals(jnp.linalg.solve(mass, R.operators(rod).stiffness)).real
    step = 1.4 * share / jnp.sqrt(jnp.max(squares))
    run = R.rollout(rod, rest, rest, weight, step=step, saves=3, every=20, stepper=stepper)
    assert run.status == getattr(Status, status)


@pytest.mark.stress(83)
def test_gas_does_not_go_below_vacuum():
    net = vessel(proportional=1e-8, integral_gain=1e-7, max_flow=1e-4, target=-2e5)
    film = S.simulate(net, 5.0)
    assert film.status == Status.successful
    assert -1.0 < float(jnp.min(film.state["air"])) < 1e3


@pytest.mark.stress(84)
@pytest.mark.parametrize(
    "force, status",
    [(-1.5 * EA, "inverted"), (1e12, "outside_model"), (0.2 * EA, "successful")],
)
def test_a_rod_inside_out_or_torn_says_so(force, status):
    rod = finger(kappa_z=2, sigma_x=1)
    found = R.equilibrium(rod, (R.TipWrench([0.0, force, 0.0]),))
    assert found.status == getattr(Status, status)


@pytest.mark.stress(85)
@pytest.mark.parametrize("turns, nodes, good", [(1, 8, True), (3, 8, False), (3, 16, True)])
def test_a_coil_that_the_nodes_do_not_carry_says_so(turns, nodes, good):
    rod = R.rod(SE2(), R.constant("kappa_z"), R.circle(1e-3), nodes=nodes, **SOFT)
    moment = 2 * np.pi * turns / 0.1 * 1e5 * float(rod.section.second_moment_z)
    found = R.equilibrium(rod, (R.TipWrench([moment, 0.0, 0.0]),))
    assert found.status == (Status.successful if good else Status.unresolved)
    off = float(jnp.abs(R.tip_pose(rod, found.q)[:2, 2]).max()) / 0.1
    assert (off < 1e-3) == good


@pytest.mark.stress(85)
@pytest.mark.parametrize("turns", [1, 5])
@pytest.mark.parametrize("given", ["numbers", "function", "traced"])
def test_the_nodes_of_a_coil_at_rest_carry_it(turns, given):
    curvature = 2 * np.pi * turns / 0.1

    def coil(curvature):
        rest = {
            "numbers": [curvature, 1.0, 0.0],
            "function": lambda s: np.tile([curvature, 1.0, 0.0], (len(s), 1)),
            "traced": jnp.zeros(3).at[0].set(curvature).at[1].set(1.0),
        }[given]
        return R.rod(SE2(), R.constant("kappa_z"), R.circle(1e-3), rest_strain=rest, **SOFT)

    if given == "traced":  # sizes cannot follow: the status tells
        found = jax.jit(lambda k: R.equilibrium(coil(k)))(jnp.asarray(curvature))
        assert found.status == (Status.successful if turns == 1 else Status.unresolved)
        return
    rod = coil(curvature)
    assert R.equilibrium(rod).status == Status.successful
    assert jnp.abs(R.tip_pose(rod, jnp.zeros(1))[:2, 2]).max() < 1e-5


@pytest.mark.stress(86)
@pytest.mark.parametrize("extra", [{}, {"limits": (-40.0, 40.0)}])
def test_inverse_kinematics_of_a_redundant_rod_has_the_slope_of_its_answers(extra):
    rod = finger(nodes=8, kappa_z=3)

    def find(target):
        return R.inverse_kinematics(rod, R.Position(target), **extra).q

    target, gap = jnp.array([0.08, 0.04]), 1e-5
    slope = jax.jacfwd(find)(target)
    ends = jax.vmap(find)(target[None] + gap * jnp.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]))
    differences = jnp.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=1) / (2 * gap)
    assert jnp.allclose(slope, differences, rtol=0, atol=1e-4 * float(jnp.abs(slope).max()))
