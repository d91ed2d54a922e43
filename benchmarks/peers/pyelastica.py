"""The finger D1 released at rest, in PyElastica: `python -I pyelastica.py FOLDER`.

Its own damping is left out; the step is a share of what an element can bear.
"""

import json
import sys
import time
from pathlib import Path

import elastica as ea
import numpy as np

LENGTH, RADIUS, MODULUS, RATIO, DENSITY = 0.08, 0.006, 1e6, 0.3, 2000.0
GRAVITY = np.array([0.0, 0.0, -9.81])
WARM_UP = 10  # steps that compile


class Scene(ea.BaseSystemCollection, ea.Constraints, ea.Forcing):
    pass


def finger(elements):
    """The clamped rod along x with its weight."""
    scene = Scene()
    rod = ea.CosseratRod.straight_rod(
        elements,
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        LENGTH,
        RADIUS,
        DENSITY,
        youngs_modulus=MODULUS,
        shear_modulus=MODULUS / 2 / (1 + RATIO),
    )
    scene.append(rod)
    scene.constrain(rod).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    scene.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=GRAVITY)
    scene.finalize()
    return scene, rod


def advance(scene, rod, step, count, every):
    """Tips after every so many steps."""
    stepper, now, tips = ea.PositionVerlet(), np.float64(0.0), []
    for k in range(count):
        now = stepper.step(scene, now, np.float64(step))
        if (k + 1) % every == 0:
            tips.append(rod.position_collection[:, -1].copy())
    return np.array(tips)


def simulation(request, arrays):
    """Tips every `save_dt`; steps of at most `share` of the time that a wave of strain
    needs for an element."""
    elements, saves = request["elements"], round(request["duration"] / request["save_dt"])
    largest = request["share"] * LENGTH / elements / np.sqrt(MODULUS / DENSITY)
    every = int(np.ceil(request["save_dt"] / largest))
    step = request["save_dt"] / every
    start = time.perf_counter()
    advance(*finger(elements), step, WARM_UP, WARM_UP)
    first, runs = time.perf_counter() - start, []
    for _ in range(request["repeats"]):
        scene, rod = finger(elements)
        start = time.perf_counter()
        tips = advance(scene, rod, step, saves * every, every)
        runs.append(time.perf_counter() - start)
    return {"compile_s": first, "runs": runs, "step": step}, {"tips": tips}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
