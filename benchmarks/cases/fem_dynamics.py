"""Motion of a body: what one step costs over its parts, and one gradient through time.

A clamped beam of nearly incompressible rubber under its weight, 100 steps of 1 ms. The floor
of a step is one residual and one back-substitution for each iteration, and one tangent with
its factor for each factorisation, timed alone on the same body; the rest is overhead. The
gradient is that of a tip displacement after 20 steps by modulus, viscosity and load.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import fem, material, mesh
from sorojax.fem.dynamics.newton import acting, fixed_rows, forces, tangent
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.units import mm

NOTE = "floor: residuals, back-substitutions, tangents and factors of the same run alone"
DIVISIONS = ((24, 6), (42, 10))
STEP, STEPS, GRADIENT_STEPS = 1e-3, 100, 20


def beam(divisions, young_modulus=1e6, weight=9.81):
    body = mesh.rectangle([0, 0], [100 * mm, 20 * mm], divisions=divisions, order=2)
    body = mesh.enrich(body)
    rubber = material.neo_hookean(
        young_modulus=young_modulus, poisson_ratio=0.499, density=1070.0
    )
    gravity = jnp.stack([jnp.zeros(()), -jnp.asarray(weight)])
    return fem.problem(
        body,
        rubber,
        kinematics=fem.PlaneStrain(20 * mm),
        supports=(fem.Fixed(body.node_sets["left"]),),
        loads=(fem.Gravity(gravity),),
    )


def run(problem, steps=STEPS):
    damping = fem.Rayleigh(0.0, 1e-4)
    return fem.simulate(problem, steps * STEP, STEP, damping=damping, save=2)


def floor_s(problem, motion):
    """Seconds that the kernels of `motion` take alone."""
    prepared, u = prepare(problem), motion.displacements[-1]
    system = problem.space.system
    rhs = np.asarray(linearise(problem, prepared, u, u).residual)
    of = acting(problem, prepared)
    matrix = np.asarray(fixed_rows((of.fixed,), tangent(of, u, u)))
    scale = iter(1 + 1e-9 * np.arange(1000))
    system.solver.factor(matrix)

    def seconds(call):
        return measure_calls(call, repeats=5).columns()["run_s_min"]

    residual = seconds(lambda: forces(of, u, u))
    stiffness = seconds(lambda: tangent(of, u, u))
    factor = seconds(lambda: system.solver.factor(matrix * next(scale)) and None)
    solve = seconds(lambda: system.solver.factor(matrix).solve(rhs))  # type: ignore[union-attr]
    stats = motion.stats
    return stats.iterations * (residual + solve) + stats.factorisations * (stiffness + factor)


def tip(theta, divisions):
    young, viscosity, weight = theta
    problem = beam(divisions, young, weight)
    motion = fem.simulate(
        problem, GRADIENT_STEPS * STEP, STEP, damping=fem.KelvinVoigt(viscosity), save=2
    )
    return motion.displacements[-1, -1, 1]


def rows():
    for divisions in DIVISIONS:
        problem = beam(divisions)
        motion = run(problem)
        timing = measure_calls(lambda p=problem: run(p).displacements, repeats=3)
        columns = timing.columns()
        floor = floor_s(problem, motion)
        settings = {
            "dof": problem.space.num_dofs,
            "steps": STEPS,
            "iterations": motion.stats.iterations,
            "factorisations": motion.stats.factorisations,
            "ms_per_step": round(1e3 * columns["run_s_min"] / STEPS, 2),
            "floor_ms_per_step": round(1e3 * floor / STEPS, 2),
        }
        yield Row("sorojax", settings, **columns, reference=NOTE)
    divisions, theta = DIVISIONS[0], jnp.array([1e6, 50.0, 9.81])

    def value(theta):
        return tip(theta, divisions)

    timing = measure_calls(lambda: jax.grad(value)(theta), repeats=3)
    slope, errors = jax.grad(value)(theta), []
    for k in range(3):
        d = jnp.zeros(3).at[k].set(1e-4 * theta[k])
        change = (value(theta + d) - value(theta - d)) / (2 * d[k])
        errors.append(abs(float(slope[k] / change) - 1))
    settings = {
        "dof": beam(divisions).space.num_dofs,
        "steps": GRADIENT_STEPS,
        "of": "gradient",
    }
    yield Row(
        "sorojax",
        settings,
        **timing.columns(),
        reference="central differences",
        error=max(errors),
        bar=1e-6,
        bar_on="error",
    )
