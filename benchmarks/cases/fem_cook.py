"""Cook's membrane at finite strain, nu 0.49 to 0.4999: which cells lock."""

from benchmarks.blocks import softened
from benchmarks.cook import REFERENCE, plane_panel, solid_panel, tip
from benchmarks.harness import Row, measure_calls, quick
from sorojax import fem, mesh

P0, NONE = fem.ConstantPressure(), fem.Displacement()
#: Element, formulation (None is the default), cells a side, bar on the error.
PLANE = (
    (mesh.Quad4(), None, (8, 16, 32), 0.01),
    (mesh.Quad9(), None, (4, 8, 16), 0.01),
    (mesh.Tri7(), None, (4, 8, 16), 0.01),
    (mesh.Tri6(), P0, (4, 8, 16), None),
    (mesh.Tri6(), NONE, (4, 8, 16), None),
    (mesh.Quad4(), NONE, (8, 16, 32), None),
)
SOLID = (
    (mesh.Hex8(), None, (8, 16)),
    (mesh.Hex8(), NONE, (8, 16)),
    (mesh.Tet10(), NONE, (4, 8)),
    (mesh.Tet10(), P0, (4, 8)),
    (mesh.Tet15(), None, (4, 8)),
)


def rows():
    short = quick("Poisson ratios but 0.4999, meshes but the finest, solids, Tri6")
    last = slice(-1 if short else None, None)
    for poisson_ratio in list(REFERENCE)[last]:
        for element, formulation, sizes, bar in PLANE:
            if short and element.name == "Tri6":
                continue
            for n in sizes[last]:
                problem = plane_panel(element, n, poisson_ratio, formulation)
                yield _row(problem, n, poisson_ratio, bar if n == sizes[-1] else None)
    for element, formulation, sizes in () if short else SOLID:
        for n in sizes:
            yield _row(solid_panel(element, n, 0.4999, formulation), n, 0.4999, None)


def _row(problem: fem.Problem, n: int, poisson_ratio: float, bar: float | None) -> Row:
    others = softened(problem)
    timing = measure_calls(lambda: fem.solve(next(others)).displacement, repeats=3)
    solution = fem.solve(problem)
    wanted = REFERENCE[poisson_ratio]
    error = tip(problem, solution) / wanted - 1
    settings = {
        "method": f"{problem.mesh.element.name} {type(problem.formulation).__name__}",
        "element": problem.mesh.element.name,
        "formulation": type(problem.formulation).__name__,
        "cells_a_side": n,
        "poisson_ratio": poisson_ratio,
        "dof": problem.space.num_dofs,
        "iterations": solution.stats.iterations,
        "cuts": solution.stats.cuts,
        "deviation_percent": round(100 * error, 3),
    }
    return Row(
        "sorojax",
        settings,
        **timing.columns(),
        error=abs(error),
        reference=wanted,
        bar=bar,
        bar_on="error",
    )
