"""Viscoelastic solids: closed forms of a point, and what memory costs a crawler a step.

Times are CPU seconds on one core, the least of runs in turn.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.crawling import run
from benchmarks.harness import Row, quick
from sorojax import fem, material
from sorojax.robots import Crawler, crawler_problem
from sorojax.units import mm

RUBBER = material.NeoHookean(3e5, 3e6)
SPECTRA = {
    1: material.Prony([0.7], [0.1]),
    5: material.Prony([0.5, 0.3, 0.2, 0.4, 0.1], [1e-3, 1e-2, 0.05, 0.3, 2.0]),
}
THREE = material.Prony([0.1, 0.08, 0.05], [0.01, 0.1, 1.0])
SIZE, STEP, DURATION = 1.5 * mm, 2e-3, 0.1
OMEGA, STEPS = 7.0, 8000


def rows():
    for count, spectrum in SPECTRA.items():
        yield _relaxation(count, spectrum)
        yield _vibration(count, spectrum)
    yield from _crawler()


def _sheared(gamma):
    return jnp.zeros((gamma.shape[0], 3, 3)).at[:, 0, 1].set(gamma) + jnp.eye(3)[None]


def _relaxation(count: int, spectrum: material.Prony) -> Row:
    """A held shear of one half, in steps that grow a thousandfold."""
    times = jnp.concatenate([jnp.array([0.0, 1e-16]), jnp.geomspace(1e-4, 10.0, 40)])
    solid = material.Viscoelastic(RUBBER, spectrum)
    F = _sheared(jnp.full(42, 0.5).at[0].set(0.0))
    found = material.stress_history(solid, times, F)[1:, 0, 1]
    exact = 1.5e5 * material.relaxation_modulus(spectrum, times[1:])
    error = float(jnp.abs(found / exact - 1).max())
    settings = {"of": "relaxation", "branches": count}
    return Row(
        "sorojax", settings, error=error, bar=1e-8, bar_on="error", reference="closed form"
    )


def _vibration(count: int, spectrum: material.Prony) -> Row:
    """A small shear that swings, its second-order error extrapolated from two steps."""

    def stress(steps):
        t = jnp.linspace(0.0, 0.9, steps + 1)

        def of(size):
            solid, gamma = material.Viscoelastic(RUBBER, spectrum), size * jnp.sin(OMEGA * t)
            return material.stress_history(solid, t, _sheared(gamma))[:, 0, 1]

        return t, jax.jvp(of, (0.0,), (1.0,))[1] / 3e5

    (t, coarse), (_, fine) = stress(STEPS), stress(2 * STEPS)
    exact = material.storage_modulus(spectrum, OMEGA) * jnp.sin(OMEGA * t)
    exact = exact + material.loss_modulus(spectrum, OMEGA) * jnp.cos(OMEGA * t)
    for g, tau in zip(spectrum.shares, spectrum.times, strict=True):
        exact = exact - g * OMEGA * tau / (1 + (OMEGA * tau) ** 2) * jnp.exp(-t / tau)
    scale = float(jnp.abs(exact).max())
    errors = [float(jnp.abs(x - exact).max()) / scale for x in (coarse, fine[::2])]
    error = float(jnp.abs((4 * fine[::2] - coarse) / 3 - exact).max()) / scale
    settings = {
        "of": "complex modulus",
        "branches": count,
        "error_of_steps": float(f"{errors[0]:.2g}"),
        "order": round(float(np.log2(errors[0] / errors[1])), 2),
    }
    return Row(
        "sorojax", settings, error=error, bar=1e-8, bar_on="error", reference="closed form"
    )


def _crawler():
    """A step of the crawler without memory, with branches, softening, and with both."""
    plain = crawler_problem(Crawler(), size=SIZE)
    soft = material.Softening(plain.material, r=2.0, m=1e3, beta=0.1)
    laws = {
        (3, False): material.Viscoelastic(plain.material, THREE),
        (0, True): soft,
        (3, True): material.Viscoelastic(soft, THREE),
    }
    problems = {key: dataclasses.replace(plain, material=law) for key, law in laws.items()}
    problems = {(0, False): plain, **problems}
    best, motions = {}, {}
    for problem in problems.values():
        run(problem, 2 * STEP, STEP, save=2)
    for _ in range(2 if quick("five runs in turn") else 5):
        for key, problem in problems.items():
            took, motions[key] = _timed(problem)
            best[key] = min(took, best.get(key, np.inf))
    for key, took in best.items():
        (count, softens), stats = key, motions[key].stats
        settings = {
            "of": "crawler",
            "branches": count,
            "softens": softens,
            "dof": plain.space.num_dofs,
            "ms_per_step": round(1e3 * took, 2),
            "iterations": round(stats.iterations / stats.steps, 2),
            "factorisations": round(stats.factorisations / stats.steps, 2),
        }
        share = took / best[0, False] - 1
        bar = {"error": share, "bar": 0.15, "bar_on": "error"} if count and not softens else {}
        yield Row("sorojax", settings, run_s=took, reference="without memory", **bar)


def _timed(problem: fem.Problem):
    """CPU time of a step [s]."""
    start = time.process_time()
    motion = run(problem, DURATION, STEP, save=2)
    return (time.process_time() - start) / motion.stats.steps, motion
