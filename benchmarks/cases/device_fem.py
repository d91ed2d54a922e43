"""Solid bodies on an accelerator, against one CPU core: tangents, their products without
and with a stored matrix, linear systems, and equilibria that never leave the device.

Conjugate gradients with multigrid, in double precision.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks import devices
from benchmarks.blocks import bent, block, softened
from benchmarks.cases.fem_iterative import iterating
from benchmarks.harness import Row, measure, measure_calls, quick
from sorojax import fem, mesh
from sorojax.fem.equilibrium.linear import constrain, linearise, prepare
from sorojax.fem.problem import residual
from sorojax.math.linalg import sparse
from sorojax.math.linalg.conjugate_gradient import iterate
from sorojax.math.linalg.multigrid import multigrid

ERROR, SAME = 1e-8, 1e-11  # of solutions and equilibria; of one pass over the cells


def problems():
    """How to make each body, and whether the CPU takes it as well."""
    yield partial(block, mesh.Hex8(), (16,) * 3, fem.Displacement()), True
    sides = (25,) if quick("blocks with up to a million unknowns") else (69, 40, 25)
    for side in sides:
        yield partial(block, mesh.Hex8(), (side,) * 3, fem.Displacement()), False
    yield partial(block, mesh.Quad4(), (158,) * 2, fem.Displacement()), True
    yield partial(block, mesh.Tet10(), (8,) * 3, fem.Displacement()), True


def tangent(problem, prepared, u):
    state = linearise(problem, prepared, u, u)
    return state.residual, state.values


def free_product(problem, u, way):
    """Tangent times `way` from the energy alone: nothing is stored."""
    return jax.jvp(lambda u: residual(problem, u), (u,), (way,))[1]


def stored_product(system, values, way):
    return sparse.product(system, values, way.ravel())


def solution(system, matrix, rhs):
    maps, settings = system.iterative.maps, system.iterative.settings
    found = iterate(multigrid(maps, matrix), rhs, settings.tolerance, settings.max_iterations)
    return found.x


def equilibrium(problem):
    return fem.solve(problem, throw=False).displacement


def _passes(problem, prepared, u, values):
    """What goes over the cells or the matrix once: the function and its arguments."""
    return {
        "tangent": (tangent, (problem, prepared, u)),
        "product, nothing stored": (free_product, (problem, u, u)),
        "product of a stored matrix": (stored_product, (problem.space.system, values, u)),
    }


def _apart(function, args):
    """The function of the arrays among its arguments, and these."""
    arrays, rest = eqx.partition(args, eqx.is_array)
    return lambda arrays: function(*eqx.combine(arrays, rest)), arrays


def _rows(device, problem, exact):
    """`exact` holds the answers of the CPU, and is given those that it lacks there."""
    u, prepared = bent(problem.mesh.points), prepare(problem)
    force, values = tangent(problem, prepared, u)
    settings = {"count": problem.space.num_dofs, "of": "dof", "devices": [device]}
    element = problem.mesh.element.name
    for what, (function, args) in _passes(problem, prepared, u, values).items():
        call, arrays = _apart(function, args)
        if exact is not None and what not in exact:
            exact[what] = jax.jit(call)(arrays)
        yield from devices.compared(
            f"{what}, {element}",
            call,
            (arrays,),
            **settings,
            error_of=devices.relative(exact[what]) if exact else lambda _: float("nan"),
            bar=SAME if exact else None,
            reference="CPU" if exact else "",
        )
    system = iterating(problem).space.system
    held = constrain(system, values, force, prepared.known)

    def missed(x):
        left = sparse.product(system, held[0], x) - held[1]
        return float(jnp.max(jnp.abs(left)) / jnp.max(jnp.abs(held[1])))

    call, arrays = _apart(solution, (system, *held))
    yield from devices.compared(
        f"linear system, {element}",
        call,
        (arrays,),
        **settings,
        error_of=missed,
        bar=ERROR,
        reference="what is left of the right-hand side",
    )
    yield _equilibrium(device, problem, prepared, exact)


def _equilibrium(device, problem, prepared, exact):
    """By conjugate gradients in one program, by the direct solver on the CPU."""
    cpu = device.platform == "cpu"
    if cpu:
        others = softened(problem)
        timing = measure_calls(lambda: fem.solve(next(others)).displacement, repeats=2)
        u = exact["equilibrium"] = fem.solve(problem).displacement
    else:
        call, arrays = _apart(equilibrium, (iterating(problem),))
        programs = []
        timing = measure(call, arrays, repeats=5, keep=programs.append)
        u = programs[0](arrays)
    found = linearise(problem, prepared, u, u)
    solver = problem.space.system.means if cpu else "conjugate gradients"
    settings = devices.named(f"equilibrium, {problem.mesh.element.name}", device) | {
        "against": "dof",
        "dof": problem.space.num_dofs,
        "solver": solver,
        "unbalanced": float(found.residual_norm / found.reference),
    }
    if cpu or exact is None:
        return Row("sorojax", settings, **timing.columns())
    return Row(
        "sorojax",
        settings,
        **timing.columns(),
        reference="direct solver",
        bar=ERROR,
        error=devices.relative(exact["equilibrium"])(u),
        bar_on="error",
    )


def rows():
    cpu, *others = devices.found()
    if not others:
        yield devices.absent()
        return
    for make, both in problems():
        exact = {} if both else None
        for device in (cpu, *others) if both else others:
            with jax.default_device(device):
                yield from _rows(device, make(), exact)
