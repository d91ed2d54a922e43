"""A rod embedded in a block against a mesh that follows it, bent and stretched.

A block of 60 x 10 x 10 mm holds a square fibre of 2 x 2 mm, 100 times as stiff, whose ends are
in walls. Straight it is bent by a force at the free end; wavy (2 mm to one side in the middle)
it is pulled straight between the walls. The error is that of the energy.
"""

from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.blocks import softened
from benchmarks.harness import Row, measure_calls
from sorojax import fem, material, mesh
from sorojax.units import mm

LENGTH, SIDE, THICK = 60 * mm, 10 * mm, 2 * mm
SOFT, STIFF = 1e5, 1e7  # Pa
BLOCKS = ((10, 2), (15, 3))  # along, across
RUBBER = material.neo_hookean(young_modulus=SOFT, poisson_ratio=0.3)


def bent(points, wave: float):
    """Lines that go to one side in the middle of the block, whose faces stay."""
    x, y, z = np.asarray(points).T
    share = 4 * z * (SIDE - z) / SIDE**2
    return np.stack([x, y, z + wave * np.sin(np.pi * x / LENGTH) ** 2 * share], axis=1)


def block(along: int, across: int) -> mesh.Mesh:
    corners = [0, 0, 0], [LENGTH, SIDE, SIDE]
    divisions = along, across, across
    return mesh.box(*corners, divisions=divisions, element=mesh.Tet10())


def resolved(wave: float, along: int = 20) -> tuple[mesh.Mesh, material.NeoHookean]:
    """Two cells across the fibre and two on each side of it."""
    even = block(along, 6)
    walls = [0, (SIDE - THICK) / 2, (SIDE + THICK) / 2, SIDE]
    lines = np.concatenate([np.linspace(a, b, 3)[:-1] for a, b in pairwise(walls)])
    lines = np.append(lines, SIDE)
    x, *across = np.asarray(even.points).T
    places = [np.interp(y, np.linspace(0, SIDE, 7), lines) for y in across]
    points = np.stack([x, *places], axis=1)
    middles = points[np.asarray(even.cells)[:, :4]].mean(axis=1)[:, 1:]
    inside = (np.abs(middles - SIDE / 2) < THICK / 2).all(axis=1)
    young = np.where(inside, STIFF, SOFT)
    cells = eqx.tree_at(lambda m: m.points, even, jnp.asarray(bent(points, wave)))
    return cells, material.NeoHookean(young / 2.6, young / 1.2)


def embedded(cells: mesh.Mesh, wave: float) -> fem.EmbeddedRod:
    at = np.linspace(0, LENGTH, 121)
    middle = np.full_like(at, SIDE / 2)
    line = bent(np.stack([at, middle, middle], axis=1), wave)
    axial = (STIFF - SOFT) * THICK**2
    return fem.embedded_rod(
        cells, line, axial_stiffness=axial, bending_stiffness=axial * THICK**2 / 12,
        clamped=(True, wave > 0),
    )  # fmt: skip


def problem(cells: mesh.Mesh, rubber, wave: float, loads=()) -> fem.Problem:
    left, right = cells.node_sets["left"], cells.node_sets["right"]
    if wave:
        ends = fem.Fixed(left), fem.Prescribed(right, [1 * mm, 0, 0])
        return fem.problem(cells, rubber, supports=ends, loads=loads)
    tip = fem.Traction(cells.facet_sets["right"], [0, 0, -2e-3 / SIDE**2], name="tip")
    return fem.problem(cells, rubber, supports=(fem.Fixed(left),), loads=(*loads, tip))


def rows():
    for wave in (0.0, 2 * mm):
        whole = problem(*resolved(wave), wave)
        wanted = float(fem.potential_energy(whole, fem.solve(whole).displacement))
        for divisions in BLOCKS:
            cells = block(*divisions)
            small = problem(cells, RUBBER, wave, (embedded(cells, wave),))
            others = softened(small)
            timing = measure_calls(lambda p=others: fem.solve(next(p)).displacement, repeats=3)
            energy = float(fem.potential_energy(small, fem.solve(small).displacement))
            first = divisions == BLOCKS[0]
            settings = {
                "case": "wavy, stretched" if wave else "straight, bent",
                "cells": f"{divisions[0]}x{divisions[1]}x{divisions[1]}",
                "dof": small.space.num_dofs,
                "resolved_dof": whole.space.num_dofs,
            }
            yield Row(
                "sorojax",
                settings,
                **timing.columns(),
                error=abs(energy / wanted - 1),
                reference=wanted,
                bar=5e-3 if first else None,
                bar_on="error",
            )
