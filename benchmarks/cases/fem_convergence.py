"""Order of convergence in L2 by a manufactured solution, with the work it takes."""

import math

from benchmarks.blocks import softened
from benchmarks.harness import Row, measure_calls
from benchmarks.manufactured import body, error
from sorojax import fem, mesh

D, P0 = fem.Displacement(), fem.ConstantPressure()
#: The field changes volume, so that a higher Poisson ratio would measure its pressure only.
#: Element, formulation (None is the default), Poisson ratio, cells a side, order expected.
SERIES = (
    (mesh.Tri3(), D, 0.3, (8, 16, 32), 2),
    (mesh.Quad4(), D, 0.3, (8, 16, 32), 2),
    (mesh.Tri6(), D, 0.3, (8, 16, 32), 3),
    (mesh.Quad8(), D, 0.3, (8, 16, 32), 3),
    (mesh.Quad4(), None, 0.45, (8, 16, 32), 2),
    (mesh.Tri6(), P0, 0.45, (8, 16, 32), None),
    (mesh.Tri7(), None, 0.45, (8, 16, 32), 3),
    (mesh.Quad9(), None, 0.45, (8, 16, 32), 3),
    (mesh.Tet10(), D, 0.3, (2, 4, 8), 3),
    (mesh.Hex8(), None, 0.45, (3, 6, 12), 2),
    (mesh.Tet10(), P0, 0.45, (2, 4, 8), None),
    (mesh.Tet15(), None, 0.45, (2, 4, 6), 3),
)


def rows():
    for element, formulation, poisson_ratio, sizes, order in SERIES:
        before = None
        for n in sizes:
            problem = body(element, n, poisson_ratio, formulation)
            others = softened(problem)
            timing = measure_calls(lambda p=others: fem.solve(next(p)).displacement, repeats=3)
            solution = fem.solve(problem)
            found = float(error(problem, solution.displacement))
            slope = before and math.log(before[1] / found) / math.log(n / before[0])
            before = n, found
            settings = {
                "element": element.name,
                "formulation": type(problem.formulation).__name__,
                "poisson_ratio": poisson_ratio,
                "cells_a_side": n,
                "dof": problem.space.num_dofs,
                "iterations": solution.stats.iterations,
                "order": slope and round(slope, 2),
                "order_of_the_functions": order,
            }
            yield Row(
                "sorojax",
                settings,
                **timing.columns(),
                error=found,
                reference="manufactured displacement, root mean square",
            )
