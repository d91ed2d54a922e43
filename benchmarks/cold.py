"""First calls in fresh processes: `python -m benchmarks.cold NAME [PROGRAMS]`.

Every scene is built before the clock starts, and JAX has run an operation. What is timed is
the first call and the second, with the cache of `SOROJAX_CACHE`. With a folder PROGRAMS JAX
writes there what it compiles, whose operations are counted; that takes time of its own.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

Call = Callable[[], Any]


class Cold(NamedTuple):
    """Seconds of the first call and of the second, and CPU seconds of this process."""

    first: float
    second: float
    first_cpu: float
    second_cpu: float


class Programs(NamedTuple):
    """How many programs two calls compile, and their operations."""

    count: int
    operations: int


def spatial_finger():
    """A finger with 11 coordinates, and a wrench on its tip."""
    import jax.numpy as jnp

    from sorojax import SE3, rod

    basis = rod.chebyshev(kappa_x=1, kappa_y=4, kappa_z=4, sigma_x=2)
    finger = rod.rod(
        SE3(),
        basis,
        rod.circle(6e-3),
        length=0.08,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=2000.0,
    )
    return finger, jnp.array([0.0, 1e-4, 2e-4, 0.0, 1e-2, 2e-2])


def at_rest() -> tuple[Callable[[Any], Any], Any]:
    """Coordinates of the finger at rest as a function of its wrench, and a wrench."""
    from sorojax import rod

    finger, wrench = spatial_finger()
    return lambda wrench: rod.equilibrium(finger, (rod.TipWrench(wrench),)).q, wrench


def equilibrium() -> Call:
    rest, wrench = at_rest()
    return lambda: rest(wrench)


def equilibrium_forward() -> Call:
    import jax

    rest, wrench = at_rest()
    return lambda: jax.jacfwd(rest)(wrench)


def equilibrium_reverse() -> Call:
    import jax

    rest, wrench = at_rest()
    return lambda: jax.jacrev(rest)(wrench)


def equilibrium_lanes() -> Call:
    import jax
    import jax.numpy as jnp

    rest, wrench = at_rest()
    wrenches = jnp.linspace(0.0, 1.0, 1000)[:, None] * wrench[None]
    return lambda: jax.vmap(rest)(wrenches)


def drop(explicit: float | None = None) -> Callable[[Any], Any]:
    """Coordinates of the finger every 2 ms after its release, by Young's modulus [Pa].

    In half a second; by the default method with steps of 2 ms, or with `explicit` ones [s]."""
    import jax.numpy as jnp

    from sorojax import replace, rod
    from sorojax.math.ode.steppers import DormandPrince

    finger, _ = spatial_finger()
    still, save = jnp.zeros(11), 2e-3
    stepper, step = (DormandPrince(), explicit) if explicit else (None, save)

    def dropped(young_modulus):
        softer = replace(finger, lambda r: r.material.young_modulus, young_modulus)
        return rod.rollout(
            softer,
            still,
            still,
            (rod.Gravity(),),
            step=step,
            saves=250,
            every=round(save / step),
            stepper=stepper,
        ).q

    return dropped


def rollout(explicit: float | None = None) -> Call:
    dropped = drop(explicit)
    return lambda: dropped(1e6)


def rollout_gradient(explicit: float | None = None) -> Call:
    import jax
    import jax.numpy as jnp

    dropped = drop(explicit)
    return lambda: jax.grad(lambda young: jnp.sum(dropped(young)[-1]))(jnp.array(1e6))


def actuator():
    """The bellows of the README and its problem, under 10 kPa."""
    import sorojax as sj
    from sorojax.units import kPa, mm

    bellows = sj.robots.BellowsActuator(base=3 * mm)
    mesh = sj.mesh.enrich(sj.mesh.triangulate(bellows.body(), size=1 * mm, order=2))
    problem = sj.fem.problem(
        mesh,
        sj.material.presets.dragon_skin_30(),
        kinematics=sj.fem.PlaneStrain(20 * mm),
        supports=(sj.fem.Fixed(sj.mesh.nodes_where(mesh, lambda p: p[0] < 1e-9)),),
        loads=(sj.fem.Pressure(sj.mesh.facets_on(mesh, bellows.chambers()), 10 * kPa),),
    )
    return mesh, problem


def under_weight():
    """Its plain triangles in a hard rubber under their weight: other codes hold that."""
    import sorojax as sj
    from sorojax.units import MPa, mm

    bellows = sj.robots.BellowsActuator(base=3 * mm)
    mesh = sj.mesh.triangulate(bellows.body(), size=1 * mm, order=2)
    return sj.fem.problem(
        mesh,
        sj.material.NeoHookean(2 * MPa, 100 * MPa, density=1080.0),
        kinematics=sj.fem.PlaneStrain(20 * mm),
        supports=(sj.fem.Fixed(sj.mesh.nodes_where(mesh, lambda p: p[0] < 1e-9)),),
        loads=(sj.fem.Gravity(),),
        formulation=sj.fem.Displacement(),
    )


def solve() -> Call:
    from sorojax import fem

    _, problem = actuator()
    return lambda: fem.solve(problem).displacement


def solve_under_weight() -> Call:
    from sorojax import fem

    problem = under_weight()
    return lambda: fem.solve(problem).displacement


def solve_gradient() -> Call:
    """By the thickness of the base, through the motion of the mesh."""
    import jax

    import sorojax as sj
    from sorojax.units import mm

    mesh, problem = actuator()

    def tip(base):
        moved = sj.mesh.move(mesh, sj.robots.BellowsActuator(base=base).body())
        bent = sj.fem.solve(sj.replace(problem, lambda p: p.mesh.points, moved.points))
        return bent.displacement[sj.mesh.nearest_node(mesh, [66 * mm, 0]), 1]

    return lambda: jax.value_and_grad(tip)(3 * mm)


def network() -> Call:
    """A finger, air, valves and their regulators for a second."""
    from benchmarks.regulated import regulated
    from sorojax import systems

    loop = regulated(10.0)
    return lambda: systems.simulate(loop, 1.0).state


def network_gradient() -> Call:
    import jax
    import jax.numpy as jnp

    from benchmarks.regulated import regulated
    from sorojax import systems

    def end(gain):
        return systems.simulate(regulated(gain), 0.2).state["finger"]["q"][-1, 0]

    return lambda: jax.grad(end)(jnp.array(10.0))


def linear() -> Call:
    """The compliance of a beam of 60 x 30 cells and its derivatives by their densities."""
    import jax
    import jax.numpy as jnp

    from sorojax import design, fem, material, mesh

    grid = mesh.rectangle([0, 0], [60, 30], divisions=(60, 30), element=mesh.Quad4())
    corner = mesh.nearest_node(grid, [60.0, 0.0])
    pull = fem.Force([corner], [0.0, -1.0], name="pull")
    problem = fem.problem(
        grid,
        material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3),
        kinematics=fem.PlaneStress(1.0),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(pull,),
        formulation=fem.Displacement(),
    )
    half = jnp.full(grid.num_cells, 0.5)

    def run():
        model, law = design.linear(problem), design.Simp(3.0)
        return jax.value_and_grad(lambda x: design.compliance(model, law(x)))(half)

    return run


#: Name of a call, what makes it, and the bar of its first call [s].
CALLS: dict[str, tuple[Callable[[], Call], float]] = {
    "rod.equilibrium": (equilibrium, 2.5),
    "rod.equilibrium, Jacobian forward": (equilibrium_forward, 3.0),
    "rod.equilibrium, Jacobian reverse": (equilibrium_reverse, 3.0),
    "rod.equilibrium, vmap over 1000": (equilibrium_lanes, 3.0),
    "rod.rollout of 0.5 s": (rollout, 1.2),
    "rod.rollout, gradient": (rollout_gradient, 4.0),
    "fem.solve": (solve, 2.5),
    "fem.solve, gradient through mesh motion": (solve_gradient, 5.0),
    "systems.simulate": (network, 1.5),
    "systems.simulate, gradient": (network_gradient, 5.0),
    "design.linear": (linear, 3.0),
}
#: Tasks that other codes have too, without bars.
SHARED: dict[str, Callable[[], Call]] = {
    "rod.rollout, explicit steps": lambda: rollout(EXPLICIT),
    "rod.rollout, explicit steps, gradient": lambda: rollout_gradient(EXPLICIT),
    "fem.solve, Tri6 under weight": solve_under_weight,
}
EXPLICIT = 2.5e-4  # s; soromox diverges with 1 ms
FROM_CACHE = 1.0  # s, the bar of all of them with a filled cache


def measured(name: str, cache: Path) -> Cold:
    """Both calls in a process of their own."""
    return cold(*_told(cache, name))


def cold(seconds: list[float], cpu: list[float]) -> Cold:
    return Cold(*seconds, *cpu)


def counted(name: str, cache: Path) -> Programs:
    """What both calls compile, in a process of their own."""
    with tempfile.TemporaryDirectory() as programs:
        _told(cache, name, programs)
        texts = [path.read_text() for path in Path(programs).glob("*.mlir")]
    return Programs(len(texts), sum(text.count(" = ") for text in texts))


def user_environment() -> dict[str, str]:
    """That of a user: checks at run time are on."""
    return {name: value for name, value in os.environ.items() if name != "EQX_ON_ERROR"}


def _told(cache: Path, *words: str) -> list[list[float]]:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.cold", *words],
        env=user_environment() | {"SOROJAX_CACHE": str(cache)},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"cold: {words[0]} failed.\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def _main(name: str, programs: str | None = None) -> None:
    import jax

    import sorojax as sj

    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.numpy.zeros(3) + 1)
    call = SHARED[name]() if name in SHARED else CALLS[name][0]()
    sj.enable_compilation_cache()
    if programs is not None:
        jax.config.update("jax_dump_ir_to", programs)
    seconds = []
    for _ in range(2):
        start = time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    print(json.dumps([*zip(*seconds, strict=True)]))


if __name__ == "__main__":
    _main(*sys.argv[1:])
