"""Which files and functions of the package a person meets who follows three calls:

    python -m tests.walks [--functions]

Each call is made once, in a process of its own, and every function of `sorojax` that Python
enters on the way is counted once; tracing is part of the way, importing is not.
"""

import argparse
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp

import sorojax
from sorojax import fem, material, mesh, rod, sdf
from sorojax.math.lie import SE3

jax.config.update("jax_enable_x64", True)
ROOT = str(Path(sorojax.__file__).parent)


def solve_under_grad() -> Callable[[], Any]:
    grid = mesh.rectangle([0, 0], [2, 1], divisions=(2, 1), element=mesh.Quad4())
    problem = fem.problem(
        grid,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3),
        kinematics=fem.PlaneStrain(0.1),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Traction(grid.facet_sets["right"], [0.0, 1e3]),),
        formulation=fem.Displacement(),
    )

    def end(pressure):
        loaded = sorojax.replace(problem, lambda p: p.loads[0].value, pressure)
        return jnp.sum(fem.solve(loaded).displacement ** 2)

    return lambda: jax.grad(end)(1e3)


def rollout() -> Callable[[], Any]:
    body = rod.rod(
        SE3(),
        rod.chebyshev(kappa_y=2),
        rod.circle(6e-3),
        length=0.1,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=1000.0,
    )
    still = jnp.zeros(2)
    return lambda: rod.rollout(
        body, still, still, (rod.Gravity(),), step=1e-3, saves=2, every=5
    )


def shape_to_mesh() -> Callable[[], Any]:
    shape = sdf.Circle([0, 0], 1.0) - sdf.Circle([0, 0], 0.5)
    return lambda: mesh.triangulate(shape, size=0.4)


WALKS = {
    "fem.solve under grad": solve_under_grad,
    "rod.rollout": rollout,
    "sdf to mesh": shape_to_mesh,
}


def crossed(call: Callable[[], Any]) -> set[tuple[str, str, int]]:
    """File, name and line of every function of the package that `call` enters."""
    found = set()

    def enter(frame: FrameType, event: str, _: Any) -> None:
        code, own = frame.f_code, frame.f_code.co_filename.startswith(ROOT)
        if event == "call" and own and not code.co_name.startswith("<"):
            file = code.co_filename[len(ROOT) + 1 :]
            found.add((file, code.co_name, code.co_firstlineno))

    sys.setprofile(enter)
    try:
        call()
    finally:
        sys.setprofile(None)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--functions", action="store_true", help="name every function")
    parser.add_argument("--only", choices=list(WALKS), help="one of the walks, in this process")
    given = parser.parse_args()
    if given.only is None:
        for name in WALKS:
            more = ["--functions"] if given.functions else []
            subprocess.run([sys.executable, __file__, "--only", name, *more], check=True)
        return
    found = crossed(WALKS[given.only]())
    files = {file for file, *_ in found}
    print(f"{given.only}: {len(files)} files, {len(found)} functions", flush=True)
    if given.functions:
        for file, name, line in sorted(found):
            print(f"  {file}:{line} {name}")


if __name__ == "__main__":
    main()
