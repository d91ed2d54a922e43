"""A soft finger as a chain of rigid segments in MuJoCo: where its tip rests, its lowest
frequency."""

import tempfile
from pathlib import Path

import numpy as np
import scipy.linalg

from benchmarks.harness import Row, measure_calls, missing, quick
from sorojax import SE3, io, rod
from sorojax.io._mujoco import parser

BARS = {"tip": 0.02, "lowest frequency": 0.05}
REFERENCES = {
    "tip": "equilibrium of the rod under its weight, relative to how far the tip sinks",
    "lowest frequency": "of the rod, clamped, without load",
}


def finger():
    """A round straight finger of 120 mm."""
    return rod.rod(
        SE3(),
        rod.chebyshev(kappa_x=1, kappa_y=4, kappa_z=4, sigma_x=1),
        rod.circle(6e-3),
        length=0.12,
        young_modulus=1e6,
        poisson_ratio=0.5,
        density=1000.0,
    )


def chain(made, segments):
    """What `export_mjcf` wrote, and the model that MuJoCo reads."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "finger.xml"
        found = io.export_mjcf(path, made, (rod.Gravity(),), segments=segments)
        return found, parser("benchmarks").MjModel.from_xml_path(str(path))


def balanced(model, data, site, load):
    """Place of a site in the state that does not accelerate under a wrench on it, by Newton."""
    mujoco, rows = parser("benchmarks"), np.zeros((2, 3, model.nv))

    def force(q):
        data.qpos[:], data.qvel[:] = q, 0
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, *rows, site)
        moment = load[:3] @ rows[1] + load[3:] @ rows[0]
        return data.qfrc_passive - data.qfrc_bias + moment

    q = model.qpos0.copy()
    for _ in range(30):
        now, steps = force(q), 1e-6 * np.eye(model.nv)
        slope = np.stack([(force(q + h) - force(q - h)) / 2e-6 for h in steps], axis=1)
        change = np.linalg.solve(slope, -now)
        q = q + change * min(1.0, 0.3 / np.abs(change).max())
        if np.abs(change).max() < 1e-9:
            break
    assert np.abs(force(q)).max() < 1e-10
    return data.site_xpos[site].copy()


def lowest(model):
    """Lowest frequency [Hz] of a chain at rest."""
    mujoco = parser("benchmarks")
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    for row, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    stiffness = np.zeros(model.nv)
    stiffness[model.jnt_dofadr] = model.jnt_stiffness
    values = scipy.linalg.eigh(np.diag(stiffness), mass, eigvals_only=True)
    return float(np.sqrt(values[0]) / (2 * np.pi))


def rows():
    try:
        mujoco = parser("benchmarks")
    except ModuleNotFoundError as reason:
        yield missing("mujoco", str(reason))
        return
    made = finger()
    rest = rod.equilibrium(made, (rod.Gravity(),))
    start, tip = (np.asarray(rod.tip_pose(made, q)[:3, 3]) for q in (0 * rest.q, rest.q))
    for segments in (8,) if quick("16 segments") else (8, 16):
        timing = measure_calls(lambda n=segments: chain(made, n)[0].text, repeats=3)
        found, model = chain(made, segments)
        place = balanced(model, mujoco.MjData(model), model.site("rod_tip").id, np.zeros(6))
        errors = {
            "tip": float(np.linalg.norm(place - tip) / np.linalg.norm(tip - start)),
            "lowest frequency": abs(lowest(model) / found.chains["rod"].frequency - 1),
        }
        for of, error in errors.items():
            yield Row(
                "sorojax",
                {"of": of, "segments": segments},
                **timing.columns(),
                error=error,
                reference=REFERENCES[of],
                bar=BARS[of],
                bar_on="error",
            )
