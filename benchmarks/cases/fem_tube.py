"""Thick tube and sphere under inner pressure against the radial equations."""

from benchmarks.blocks import softened
from benchmarks.harness import Row, measure_calls
from benchmarks.thick import (
    INNER,
    OUTER,
    incompressible_displacement,
    inner_displacement,
    quarter,
    sphere,
    straight_tube,
    tube,
    wall_displacement,
)
from sorojax import fem, mesh

PRESSURE = 0.3  # of the shear modulus
BODIES = {"tube": (tube, 1), "straight tube": (straight_tube, 1), "sphere": (sphere, 2)}
#: Body, element, formulation (None is the default), meshes; the bar is for the last one.
SERIES = (
    ("tube", mesh.Quad9(), None, ((6, 6), (12, 12), (24, 24)), 1e-6),
    ("tube", mesh.Tri7(), None, ((6, 6), (12, 12), (24, 24)), None),
    ("tube", mesh.Tri6(), fem.Displacement(), ((6, 6), (12, 12), (24, 24)), None),
    ("straight tube", mesh.Quad9(), None, ((8, 1), (16, 1), (32, 1)), 1e-6),
    ("sphere", mesh.Quad9(), None, ((8, 8), (16, 16), (32, 32)), 1e-6),
    ("sphere", mesh.Tri7(), None, ((6, 6), (12, 12), (24, 24)), None),
)


def _cells(body: str, element: mesh.AbstractElement, divisions: tuple[int, int]) -> mesh.Mesh:
    if body != "straight tube":
        return quarter(element, divisions)
    return mesh.rectangle([INNER, 0], [OUTER, 0.2], divisions=divisions, element=element)


def rows():
    for body, element, formulation, meshes, bar in SERIES:
        make, hoops = BODIES[body]
        for divisions in meshes:
            problem = make(
                _cells(body, element, divisions), 50.0, PRESSURE, formulation=formulation
            )
            here = bar if divisions == meshes[-1] else None
            wanted = inner_displacement(hoops, 50.0, PRESSURE)
            yield _row(problem, body, divisions, wanted, here)
    yield from _incompressible()


def _row(problem: fem.Problem, body: str, divisions, wanted: float, bar) -> Row:
    others = softened(problem)
    timing = measure_calls(lambda: fem.solve(next(others)).displacement, repeats=3)
    solution = fem.solve(problem)
    settings = {
        "body": body,
        "element": problem.mesh.element.name,
        "formulation": type(problem.formulation).__name__,
        "cells": list(divisions),
        "dof": problem.space.num_dofs,
        "bulk_over_shear": float(problem.material.bulk_modulus),  # type: ignore
        "iterations": solution.stats.iterations,
    }
    return Row(
        "sorojax",
        settings,
        **timing.columns(),
        error=abs(wall_displacement(problem, solution) / wanted - 1),
        reference=wanted,
        bar=bar,
        bar_on="error",
    )


def _incompressible():
    """The closed form without change of volume, as the bulk modulus grows."""
    for body in ("tube", "sphere"):
        make, hoops = BODIES[body]
        cells = quarter(mesh.Quad9(), (12, 12))
        space = fem.space(cells)
        wanted = incompressible_displacement(hoops, PRESSURE)
        for bulk in (1e2, 1e3, 1e4):
            problem = make(cells, bulk, PRESSURE, space=space)
            yield _row(problem, f"{body}, incompressible reference", (12, 12), wanted, None)
