"""Residual and tangent with their scatter, CPU time per cell, against the peers."""

import numpy as np

from benchmarks import peers
from benchmarks.blocks import BLOCKS, bent, block, cpu_timing, merged
from benchmarks.harness import Row, missing, quick
from sorojax import fem
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.equilibrium.linear import prepare
from sorojax.math.linalg import sparse

#: Seconds per cell that the displacement form may take; the default mixed form, 1.5 times.
BARS = {"Tri3": 350e-9, "Quad4": 1.3e-6, "Tri6": 2.6e-6, "Tet10": 22e-6, "Hex8": 22e-6}
NOTE = "tangent times a vector, of felupe on the same mesh"
REPEATS = 7
#: Peers that take tenths of a millisecond a cell and more: which cells, and how many a side.
SMALL = {"Tri3": (60, 60), "Quad4": (60, 60), "Tet10": (4, 4, 4)}
SLOW = {
    "scikit_fem": SMALL,
    "torch_fem": SMALL | {"Hex8": (8, 8, 8)},
    "jax_fem": SMALL | {"Hex8": (8, 8, 8)},
}


def rows():
    for name, (element, divisions) in BLOCKS.items():
        if quick("elements but Quad4 and Tet10") and name not in ("Quad4", "Tet10"):
            continue
        plain = block(element, divisions, fem.Displacement())
        timings, answers = [], []
        for _ in range(1 if quick() else 2):  # interleaved: both meet the same machine
            timings.append(_time(plain))
            if name in BARS:
                answers.append(_ask("felupe", plain, REPEATS))
        error = _difference(plain, answers[0]) if answers else None
        yield _row(plain, merged(*timings), BARS.get(name), error)
        if name in BARS:
            yield _peer_row("felupe", plain, answers, None)
        for peer, sizes in SLOW.items():
            if name in sizes and not (quick(f"{peer} but for Quad4") and name != "Quad4"):
                small = block(element, sizes[name], fem.Displacement())
                answer = _ask(peer, small, 3)
                yield _peer_row(peer, small, [answer], _difference(small, answer))
        mixed = block(element, divisions)
        if not isinstance(mixed.formulation, fem.Displacement):
            bar = 1.5 * BARS[name] if name in BARS else None
            yield _row(mixed, _time(mixed), bar, None)


def _state(problem: fem.Problem):
    u = bent(problem.mesh.points)
    return problem.space, prepare(problem).geometry, problem.material, problem.kinematics, u, u


def _time(problem: fem.Problem):
    state = _state(problem)
    return cpu_timing(lambda: asm.assemble(*state), REPEATS)


def _settings(problem: fem.Problem) -> dict:
    return {
        "element": problem.mesh.element.name,
        "formulation": type(problem.formulation).__name__,
        "cells": problem.space.num_cells,
        "dof": problem.space.num_dofs,
        "clock": "CPU time per cell",
    }


def _row(problem, timing, bar, error) -> Row:
    per_cell = timing.per(problem.space.num_cells).columns()
    return Row(
        "sorojax",
        _settings(problem),
        **per_cell,
        bar=bar,
        error=error,
        reference=None if error is None else NOTE,
    )


def _way(problem: fem.Problem) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(problem.mesh.points.shape)


def _ask(peer: str, problem: fem.Problem, repeats: int):
    """Answer and arrays of a peer, or the reason why there are none."""
    rubber = problem.material
    arrays = {
        "points": np.asarray(problem.mesh.points),
        "cells": np.asarray(problem.mesh.cells),
        "u": np.asarray(bent(problem.mesh.points)),
        "way": _way(problem),
    }
    try:
        return peers.call(
            peer,
            "assembly",
            arrays,
            element=problem.mesh.element.name,
            repeats=repeats,
            mu=float(rubber.shear_modulus),  # type: ignore
            bulk=float(rubber.bulk_modulus),  # type: ignore
        )
    except peers.PeerMissing as reason:
        return str(reason)


def _difference(problem: fem.Problem, answer) -> float | None:
    if isinstance(answer, str):
        return None
    found = answer[1]
    values = asm.assemble(*_state(problem)).values
    product = sparse.product(problem.space.system, values, _way(problem).ravel())  # type: ignore
    return float(np.abs(product - found["product"]).max() / np.abs(found["product"]).max())


def _peer_row(peer: str, problem: fem.Problem, answers, error: float | None) -> Row:
    settings = _settings(problem)
    if isinstance(answers[0], str):
        return missing(peer, answers[0], **settings)
    runs = sorted(run for answer, _ in answers for run in answer["runs"])
    runs = [run / problem.space.num_cells for run in runs]
    settings |= {"version": answers[0][0]["version"]}
    note = None if error is None else "tangent times a vector, of sorojax"
    first = answers[0][0]["compile_s"]
    return Row(peer, settings, first, runs[len(runs) // 2], runs[0], runs[-1], error, note)
