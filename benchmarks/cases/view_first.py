"""First picture in a fresh process with a warm compilation cache, by sorojax's own renderer:
seconds from before `import jax` to a PNG file."""

import json
import os
import statistics
import subprocess
import sys
import tempfile

from benchmarks.harness import Row

PROGRAM = """
import json, sys, time
start = time.perf_counter()
import jax
jax.config.update("jax_enable_x64", True)
import sorojax as sj
sj.enable_compilation_cache()
kind, file = sys.argv[1:]
if kind == "mesh":
    thing = sj.mesh.box([0, 0, 0], [0.06, 0.02, 0.02], divisions=(12, 4, 4))
elif kind == "shape":
    thing = sj.sdf.Sphere([0, 0, 0], 0.02) - sj.sdf.Box([0, -0.01, -0.01], [0.1, 0.01, 0.01])
elif kind == "rod":
    thing = sj.rod.rod(sj.SE3(), sj.rod.chebyshev(kappa_y=2), sj.rod.circle(0.008), length=0.12,
                       young_modulus=1e5, poisson_ratio=0.49, density=1e3)
else:
    mesh = sj.mesh.rectangle([0, 0], [0.06, 0.01], divisions=(24, 4), order=2)
    problem = sj.fem.problem(
        mesh, sj.material.neo_hookean(young_modulus=1e5, poisson_ratio=0.4),
        kinematics=sj.fem.PlaneStrain(0.02),
        supports=(sj.fem.Fixed(mesh.node_sets["left"]),),
        loads=(sj.fem.Traction(mesh.facet_sets["right"], [0.0, -300.0]),),
    )
    thing = sj.fem.solve(problem)
made = time.perf_counter()
options = {} if kind == "solution" else {"renderer": "own"}
sj.view.show(thing, **options).save(file)
done = time.perf_counter()
print(json.dumps({"whole": done - start, "show": done - made}))
"""
KINDS = ("mesh", "shape", "rod", "solution")
REPEATS, BAR = 3, 3.0


def once(kind: str, cache: str) -> dict[str, float]:
    """Seconds of the whole and of `show` in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, kind, f"{folder}/first.png"],
            env=os.environ | {"SOROJAX_CACHE": cache},
            capture_output=True,
            text=True,
            check=True,
        )
    return json.loads(done.stdout.splitlines()[-1])


def rows():
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as cache:
            cold = once(kind, cache)["whole"]
            runs = [once(kind, cache) for _ in range(REPEATS)]
        whole = [run["whole"] for run in runs]
        settings = {"first": kind, "of which show": statistics.median(r["show"] for r in runs)}
        yield Row(
            "sorojax",
            settings,
            compile_s=max(0.0, cold - statistics.median(whole)),
            run_s=statistics.median(whole),
            run_s_min=min(whole),
            run_s_max=max(whole),
            bar=BAR,
        )
