"""The cantilever at large displacement of Wang et al. 2014: end compliance of the optima."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import design, fem, material, mesh
from sorojax._progress import silent

#: Force [N] and end compliance published [J].
LOADS = ((144e3, 21.2747e3), (240e3, 56.9401e3), (300e3, 84.9415e3))
STEPS = 260
WITHIN = 0.02


def rows():
    for force, published in LOADS:
        found, seconds, density = optimised(force)
        reached = float(found.objective)
        settings = {"layout": "nonlinear cantilever", "force_kN": force / 1e3,
                    "compliance_kJ": reached / 1e3, "over_published": reached / published - 1,
                    "steps": len(seconds),
                    "volume": float(jnp.mean(density)), "status": str(found.status),
                    "grey": float(design.greyness(density))}  # fmt: skip
        timing = (float(np.median(seconds[3:])), min(seconds), max(seconds[3:]))
        yield Row("sorojax", settings, seconds[0], *timing, error=abs(reached / published - 1),
                  bar=WITHIN, bar_on="error",
                  reference="Wang, Lazarov, Sigmund, Jensen 2014; time of a step")  # fmt: skip


def continuation(k: int) -> tuple[float, float]:
    """Exponent and sharpness at step k: 1 to 3 by 0.05, every 2 steps up to 2 and every 5
    from there; then 4 to 64, doubled in 10 steps, in small ones lest a grey bar vanishes."""
    early = min(k // 2, 20)
    late = max(0, (k - 40) // 5)
    penalty = min(1 + 0.05 * early + 0.05 * late, 3.0)
    doubled = min(max(0, k - 140) / 10, 4.0)
    return penalty, 4.0 * 2.0**doubled


def cantilever(force: float, nx: int = 120, ny: int = 30) -> fem.Problem:
    """1 m x 0.25 m x 0.1 m of 3 GPa, nu 0.4, held at the left, loaded at the right."""
    grid = mesh.rectangle([0, 0], [1.0, 0.25], divisions=(nx, ny), element=mesh.Quad4())
    end = jnp.array([mesh.nearest_node(grid, [1.0, 0.125])])
    return fem.problem(
        grid, material.st_venant_kirchhoff(young_modulus=3e9, poisson_ratio=0.4),
        kinematics=fem.PlaneStrain(0.1), supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Force(end, [0.0, -force]),), formulation=fem.Displacement(),
    )  # fmt: skip


def optimised(force: float, steps: int = STEPS):
    """The optimum, the time of every step and the densities."""
    problem = cantilever(force)
    plan = design.layout(problem.mesh, radius=0.25 / 8)
    solved = design.Follower(steps=4)

    @jax.jit
    def density(x, sharpness):
        return plan(x, sharpness)

    @jax.jit
    def factor(x, penalty, sharpness):
        return design.Simp(penalty, 1e-9)(plan(x, sharpness))

    def compliance(x, penalty, sharpness):
        body = design.graded(problem, factor(x, penalty, sharpness))
        return design.work_of_loads(body, solved(body).displacement)

    @jax.jit
    def volume(x, penalty, sharpness):
        return plan.volume_fraction(plan(x, sharpness)) / 0.5 - 1

    seconds, last = [], time.perf_counter()

    def tick(_):
        nonlocal last
        now = time.perf_counter()
        seconds.append(now - last)
        last = now

    with silent():
        found = design.minimise(
            compliance, jnp.full(plan.num_variables, 0.5), constraints=(volume,), steps=steps,
            schedule=lambda k: tuple(map(jnp.asarray, continuation(k))), on_step=tick,
            optimiser=design.MMA(move=0.1),
        )  # fmt: skip
    return found, seconds, density(found.design, jnp.asarray(continuation(steps)[1]))
