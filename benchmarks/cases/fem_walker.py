"""The passive walker on its slope: frequency of its gait, cost, contact stiffness."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import fem
from sorojax.robots import Walker, pair_angles, walker_problem
from sorojax.units import mm

SIZE, STEP, DURATION, PUSH = 1.2 * mm, 1e-3, 0.4, 0.2  # m, s, s, m/s
DAMPING = fem.Rayleigh(mass=1.5)


def walk(problem: fem.Problem, step: float = STEP, push: float = PUSH) -> fem.Motion:
    """From rest on the slope, pushed downhill."""
    rest = jnp.zeros_like(problem.mesh.points)
    start = rest, rest.at[:, 0].set(push)
    return fem.simulate(problem, DURATION, step, start=start, damping=DAMPING)


def frequency(times, angle) -> float:
    """Strongest frequency [Hz] above 6 Hz in the second half of a record."""
    half = slice(len(times) // 2, None)
    wave = np.asarray(angle)[half] - np.mean(angle[half])
    size = 16 * len(wave)
    power = np.abs(np.fft.rfft(wave * np.hanning(len(wave)), size))
    at = np.fft.rfftfreq(size, float(times[1] - times[0]))
    return float(at[at > 6][np.argmax(power[at > 6])])


def rows():
    walker = Walker()
    base = walker_problem(walker, size=SIZE)
    law: Any = base.loads[-1]
    stiffer = eqx.tree_at(
        lambda p: (p.loads[-1].stiffness, p.loads[-1].friction_stiffness),
        base, (2 * law.stiffness, 2 * law.friction_stiffness),
    )  # fmt: skip
    for name, problem, push in (
        ("pushed", base, PUSH), ("at rest", base, 0.0), ("stiffer contact", stiffer, PUSH),
    ):  # fmt: skip
        timing = measure_calls(
            lambda p=problem, v=push: walk(p, push=v).displacements, repeats=1
        )
        motion = walk(problem, push=push)
        angles = np.degrees(np.asarray(pair_angles(walker, base.mesh, motion.displacements)))
        late = angles[len(angles) // 2 :]
        weights = fem.lumped_mass(base)[::2]
        way = jnp.einsum("n,tn->t", weights, motion.displacements[..., 0]) / jnp.sum(weights)
        settings = {
            "case": name,
            "dof": base.space.num_dofs,
            "frequency_Hz": [
                round(frequency(motion.times, angles[:, k]), 2) for k in range(angles.shape[1])
            ],
            "swing_deg": np.round(np.ptp(late, axis=0), 2).tolist(),
            "way_mm": round(float(way[-1]) / mm, 1),
            "steps": motion.stats.steps,
            "iterations": round(motion.stats.iterations / motion.stats.steps, 1),
            "cuts": motion.stats.cuts,
        }
        yield Row("sorojax", settings, **timing.columns())
