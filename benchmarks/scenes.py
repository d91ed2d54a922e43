"""Small scenes with and without one feature each: what is absent must cost nothing."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from sorojax import fem, material, mesh, rod as R, sdf, systems as S
from sorojax.contact import LinePenalty
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.math.lie import SE2, SE3

FINGER: dict[str, Any] = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
LAW: dict[str, Any] = dict(stiffness=5e7, smoothing=6e-6)
FLOOR = sdf.HalfSpace([0.0, 0.0, -0.015], [0.0, 0.0, 1.0])


class Feature(NamedTuple):
    """A scene without and with a feature: each a function and its arguments."""

    name: str
    without: tuple[Callable[..., Any], tuple]
    with_it: tuple[Callable[..., Any], tuple]


def operations(scene: tuple[Callable[..., Any], tuple]) -> tuple[int, float]:
    """Instructions of the compiled program, and its floating-point operations."""
    function, args = scene
    compiled = jax.jit(function).lower(*args).compile()
    lines = (line.strip() for line in (compiled.as_text() or "").splitlines())
    count = sum(" = " in line and " parameter(" not in line for line in lines)
    cost: Any = compiled.cost_analysis()
    return count, float((cost[0] if isinstance(cost, list) else cost).get("flops", 0.0))


def _rod(group: Any, forces: tuple = (), **strains: int):
    body = R.rod(group, R.chebyshev(**strains), R.circle(6e-3), nodes=8, **FINGER)
    size = sum(strains.values())
    state = jnp.linspace(1.0, 2.0, size), jnp.linspace(-3.0, 3.0, size)
    return (lambda q, v: R.vector_field(body, forces)(0.0, (q, v))), state


def _bent(forces: tuple = ()):
    return _rod(SE3(), forces, kappa_y=3, kappa_z=3)


def _contact(**friction: float):
    law = LinePenalty(**LAW, **friction)
    return R.ObstacleContact(obstacle=FLOOR, radius=6e-3, law=law, points=16)


GRID = mesh.rectangle([0, 0], [1, 1], divisions=(8, 8), element=mesh.Quad4())
RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000.0)


def _solid(rubber: Any = RUBBER, loads: tuple = ()):
    """Residual and tangent of a block."""
    problem = fem.problem(
        GRID,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        loads=loads,
        supports=(fem.Fixed(GRID.node_sets["left"]),),
    )
    prepared = prepare(problem)
    arrays, static = eqx.partition((problem, prepared), eqx.is_array)

    def at(arrays, u):
        problem, prepared = eqx.combine(arrays, static)
        state = linearise(problem, prepared, u, u)
        return state.residual, state.values

    return at, (arrays, 1e-3 * GRID.points)


def _loop(air: bool = False, logged: bool = False):
    """Rate of a finger with a chamber, alone or with the gas in it; all outputs if logged."""
    body = R.rod(SE2(), R.chebyshev(kappa_z=3), R.circle(6e-3), nodes=8, **FINGER)
    forces = (R.thread_chambers(body, R.Straight([4e-3, 0.0]), 2e-5), R.Damping(0.01))
    finger: dict[str, Any] = {"finger": S.RodBody(body, forces if air else forces[1:])}
    wires = {
        "finger.pressure": "air.pressure",
        "air.volume": "finger.volume",
        "air.volume_rate": "finger.volume_rate",
    }
    if air:
        finger["air"] = S.Reservoir()
    network = S.Network(finger, wires if air else {})
    zero = jnp.zeros(())

    def rate(state):
        out = S.outputs(network, zero, state) if logged else {}
        return network.vector_field(zero, state), out

    return rate, (network.initial_state(),)


def features() -> tuple[Feature, ...]:
    """All features, each against the scene without it."""
    sides = jnp.concatenate([GRID.facet_sets[k] for k in ("bottom", "right", "top")])
    follower = fem.Pressure(sides, 1e3, name="air")
    floor = fem.Contact(GRID.facet_sets["bottom"], sdf.HalfPlane([0.0, -0.1], [0.0, 1.0]))
    other = material.MooneyRivlin(2e5, 1e5, 5e6, 1000.0)
    top = mesh.cells_where(GRID, lambda p: p[1] > 0.5)
    halves = material.by_region(GRID.num_cells, {"top": top}, RUBBER, {"top": other})
    return (
        Feature("gravity", _bent(), _bent((R.Gravity(),))),
        Feature("damping", _bent(), _bent((R.Damping(0.01),))),
        Feature("contact", _bent(), _bent((_contact(),))),
        Feature("friction", _bent((_contact(),)), _bent((_contact(friction=0.5),))),
        Feature("torsion", _bent(), _rod(SE3(), kappa_x=3, kappa_y=3, kappa_z=3)),
        Feature("shear", _bent(), _rod(SE3(), kappa_y=3, kappa_z=3, sigma_y=1)),
        Feature("extension", _bent(), _rod(SE3(), kappa_y=3, kappa_z=3, sigma_x=1)),
        Feature("third dimension", _rod(SE2(), kappa_z=3), _rod(SE3(), kappa_z=3)),
        Feature("fluidics", _loop(), _loop(air=True)),
        Feature("logging", _loop(air=True), _loop(air=True, logged=True)),
        Feature("follower load", _solid(), _solid(loads=(follower,))),
        Feature("contact of solids", _solid(), _solid(loads=(floor,))),
        Feature("second material", _solid(), _solid(halves)),
    )
