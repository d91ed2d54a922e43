"""The finger D1 released at rest, as a cable of MuJoCo: `python -I mujoco.py FOLDER`.

A chain of rigid links and ball joints with the stiffness in bending and torsion of the
rod: it neither stretches nor shears.
"""

import json
import os
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

LENGTH, RADIUS, MODULUS, RATIO, DENSITY = 0.08, 0.006, 1e6, 0.3, 2000.0
clock = time.process_time if os.environ.get("SOROJAX_BENCH_CPU") == "1" else time.perf_counter
SCENE = """
<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <option timestep="{step}" gravity="0 0 -9.81" integrator="{integrator}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <composite type="cable" curve="s" count="{points} 1 1" size="{length}" initial="none">
      <plugin plugin="mujoco.elasticity.cable">
        <config key="twist" value="{shear_modulus}"/>
        <config key="bend" value="{young_modulus}"/>
        <config key="vmax" value="0"/>
      </plugin>
      <joint kind="main" damping="0" armature="0"/>
      <geom type="cylinder" size="{radius}" density="{density}"/>
    </composite>
  </worldbody>
</mujoco>
"""


def simulation(request, arrays):
    """Tips every `save_dt` of a cable of so many `links`."""
    start = clock()
    links, step = request["links"], request["dt"]
    text = SCENE.format(
        step=step,
        integrator=request["method"],
        points=links + 1,
        length=LENGTH,
        shear_modulus=MODULUS / 2 / (1 + RATIO),
        young_modulus=MODULUS,
        radius=RADIUS,
        density=DENSITY,
    )
    model = mujoco.MjModel.from_xml_string(text)
    built, runs = clock() - start, []
    every, saves = (
        round(request["save_dt"] / step),
        round(request["duration"] / request["save_dt"]),
    )
    for _ in range(request["repeats"]):
        data, tips = mujoco.MjData(model), []
        start = clock()
        for _ in range(saves):
            mujoco.mj_step(model, data, every)
            mujoco.mj_kinematics(model, data)
            last = data.xmat[-1].reshape(3, 3)
            tips.append(data.xpos[-1] + last[:, 0] * LENGTH / links)
        runs.append(clock() - start)
    return {"compile_s": built, "runs": runs}, {"tips": np.array(tips)}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
