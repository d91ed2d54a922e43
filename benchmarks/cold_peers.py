"""First calls of other codes beside those of sorojax, on the tasks of `cold.SHARED`.

Fresh processes as there; JAX's own cache is switched on for all peers. diffrax has a plain
linear equation of the same size: what the first call of a motion costs at least.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import cold, peers
from benchmarks.harness import Row, missing
from sorojax import fem, material

DURATION, SAVE = 0.5, 2e-3  # s
FINGER = {
    "nodes": 16,  # with 8, as sorojax has, the motion of soromox is off by 1.3e-3
    "strains": ["kappa_x", "kappa_y", "kappa_z", "sigma_x"],
    "orders": [0, 3, 3, 1, 0, 0],
    "duration": DURATION,
    "dt": cold.EXPLICIT,
    "save_dt": SAVE,
}
FINE = "steps of 0.1 ms by DormandPrince, relative"
EXACT = "exact solution, relative"
Arrays = dict[str, np.ndarray]


class Task(NamedTuple):
    """What a peer is asked, what it is told apart by, and the answer within a tolerance."""

    peer: str
    call: str
    options: dict[str, Any]
    arrays: Arrays
    wanted: np.ndarray
    reference: str
    agrees_to: float


def rows() -> Iterator[Row]:
    """Each task by sorojax, where it is the same, and by the peer."""
    for ours, make in (
        ("rod.rollout, explicit steps", _rollout),
        ("rod.rollout, explicit steps, gradient", _rollout_gradient),
        ("fem.solve, Tri6 under weight", _solve),
    ):
        task = make(ours)
        found = np.asarray(cold.SHARED[ours]()())
        yield from _sorojax(ours, error(found, task.wanted), task.reference)
        yield from _peer(task)
    for call, size, duration, save in (
        ("a plain equation for rod.rollout", 11, DURATION, SAVE),
        ("a plain equation for systems.simulate", 6, 1.0, 5e-3),
    ):
        for what in ("motion", "gradient"):
            yield from _peer(_chain(call, size, duration, save, what))


def error(found: np.ndarray, wanted: np.ndarray) -> float:
    """Relative, in the norm of all entries but a start that only some codes answer."""
    gap = np.atleast_1d(found)[-len(wanted) :] - wanted
    return float(np.linalg.norm(gap) / np.linalg.norm(wanted))


def three(
    code: str,
    call: str,
    empty: cold.Cold,
    filled: cold.Cold,
    counts: dict[str, int] | None = None,
    **columns: Any,
) -> Iterator[Row]:
    """The rows of a call: first with an empty cache, with a filled one, and the second call."""
    for cache, run_s, cpu_s, told in (
        ("empty", empty.first, empty.first_cpu, counts or {}),
        ("filled", filled.first, filled.first_cpu, {}),
        ("second call", empty.second, empty.second_cpu, {}),
    ):
        settings = {"call": call, "cache": cache, "cpu_s": round(cpu_s, 4)} | told
        yield Row(code, settings, run_s=run_s, **columns)


def _sorojax(call: str, wrong: float, reference: str) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as cache:
        empty, filled = (cold.measured(call, Path(cache)) for _ in range(2))
    yield from three("sorojax", call, empty, filled, error=wrong, reference=reference)


def _peer(task: Task) -> Iterator[Row]:
    told = {"agrees_to": task.agrees_to}
    try:
        with tempfile.TemporaryDirectory() as cache:
            (empty, arrays), (filled, _) = (_asked(task, cache) for _ in range(2))
    except peers.PeerMissing as reason:
        yield missing(task.peer, str(reason), call=task.call, **told)
        return
    told |= {"version": empty["version"]}
    for row in three(
        task.peer,
        task.call,
        cold.cold(empty["seconds"], empty["cpu"]),
        cold.cold(filled["seconds"], filled["cpu"]),
        error=error(arrays["result"], task.wanted),
        reference=task.reference,
        bar=task.agrees_to,
        bar_on="error",
    ):
        yield replace(row, settings=row.settings | told)


def _asked(task: Task, cache: str) -> tuple[dict[str, Any], Arrays]:
    kept = {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    environment = cold.user_environment() | kept
    return peers.call(
        task.peer, "first_calls", task.arrays, environment=environment, **task.options
    )


def _rollout(call: str) -> Task:
    wanted = np.asarray(cold.rollout(1e-4)())[1:]
    return Task("soromox", call, FINGER | {"what": "rollout"}, {}, wanted, FINE, 1e-3)


def _rollout_gradient(call: str) -> Task:
    wanted = np.asarray(cold.rollout_gradient(1e-4)())[None]
    return Task("soromox", call, FINGER | {"what": "gradient"}, {}, wanted, FINE, 0.1)


def _solve(call: str) -> Task:
    problem = cold.under_weight()
    nodes = np.asarray(problem.supports[0].nodes)
    rubber, (weight,) = problem.material, problem.loads
    assert isinstance(rubber, material.NeoHookean) and rubber.density is not None
    assert isinstance(weight, fem.Gravity)
    arrays = {
        "points": np.asarray(problem.mesh.points),
        "cells": np.asarray(problem.mesh.cells),
        "fixed": (2 * nodes[:, None] + np.arange(2)).ravel(),
        "weight": float(rubber.density) * np.asarray(weight.value),
    }
    options = {
        "element": problem.mesh.element.name,
        "degree": 4,  # of its quadrature: that of sorojax
        "mu": float(rubber.shear_modulus),
        "bulk": float(rubber.bulk_modulus),
        "max_iterations": 30,
        "tolerance": 1e-9,
    }
    wanted = np.asarray(cold.solve_under_weight()())
    return Task("jax_fem", call, options, arrays, wanted, "sorojax, relative", 1e-6)


def _chain(call: str, size: int, duration: float, save: float, what: str) -> Task:
    """Masses between springs, of 100 rad/s at most, the first one pulled."""
    chain = 2500.0 * (2 * np.eye(size) - np.eye(size, k=1) - np.eye(size, k=-1))
    start = np.eye(size)[0]
    squares, modes = np.linalg.eigh(chain)
    times = np.linspace(0, duration, round(duration / save) + 1)
    angles = times[:, None] * np.sqrt(squares)
    share = modes.T @ start
    exact = {
        "motion": (np.cos(angles) * share) @ modes.T,
        "gradient": np.sum((-np.sin(angles[-1]) * angles[-1] / 2 * share) @ modes.T)[None],
    }[what]
    options = {"what": what, "duration": duration, "dt": save, "saves": len(times) - 1}
    call = call if what == "motion" else f"{call}, gradient"
    return Task("diffrax", call, options, {"chain": chain, "start": start}, exact, EXACT, 1e-3)
