"""What the report compares, row by row, and which cases show a row in little time."""

from collections.abc import Iterable
from typing import NamedTuple

FURTHER = "further cases"


class Cases(NamedTuple):
    """Cases of a row: those of a quick run, and the others."""

    quick: tuple[str, ...]
    more: tuple[str, ...] = ()


ROWS = {
    "rod statics": Cases(("rod.statics",), ("rod.accuracy", "rod.closed", "rod.frequencies")),
    "rod dynamics": Cases(
        ("rod.acceleration", "rod.simulation", "rod.continuum", "robots.arm"),
        (
            "rod.assembly",
            "rod.contact",
            "rod.damped",
            "rod.drift",
            "rod.flight",
            "rod.loops",
            "rod.spin",
            "robots.export",
        ),
    ),
    "rod batches": Cases(("rod.batch",)),
    "FEM assembly": Cases(("fem.assembly",), ("fem.newton",)),
    "FEM equilibrium": Cases(
        ("fem.case_a",),
        (
            "fem.batch",
            "fem.beam_data",
            "fem.convergence",
            "fem.embedded",
            "fem.iterative",
            "fem.pneunet",
            "fem.tube",
        ),
    ),
    "near incompressibility": Cases(("fem.cook",)),
    "buckling": Cases(("fem.buckling",)),
    "FEM dynamics with contact": Cases(
        ("fem.friction",),
        (
            "fem.contact",
            "fem.crawler",
            "fem.dynamics",
            "fem.hertz",
            "fem.release",
            "fem.walker",
            "material.viscoelastic",
        ),
    ),
    "SDF evaluation and surfaces": Cases(
        ("sdf.value", "sdf.surface"), ("sdf.gallery", "sdf.normal", "sdf.volume")
    ),
    "meshing": Cases(("mesh.triangulate", "mesh.tetrahedralise")),
    "topology optimisation": Cases(
        ("design.layout",),
        (
            "design.calibrate",
            "design.gradient",
            "design.mma",
            "design.nonlinear",
            "design.pneunet",
        ),
    ),
    "system integration": Cases(
        ("systems.easy", "systems.stiff"),
        ("systems.batch", "systems.fem", "systems.hand", "systems.sampled"),
    ),
    "inverse kinematics and estimator": Cases(("rod.ik", "systems.estimator")),
    "environments": Cases(("envs.steps",), ("envs.contact_steps",)),
    "gradients": Cases(
        ("fem.gradient",),
        ("reduction.gradient", "reduction.remesh", "rod.gradient", "design.uncertainty"),
    ),
    "start": Cases(("cli.import", "rod.first_call"), ("cold.calls", "view.first")),
    "pictures": Cases(("view.skin",), ("view.film", "view.web")),
    "single precision": Cases(("precision.single",)),
    "what a scene does not need": Cases(("skip.features",)),
    "measured robots": Cases((), ("validation.beam", "validation.tentacle")),
    "wrong answers": Cases(
        (), ("contact.grid", "contact.solids", "systems.steps", "mesh.fuzz")
    ),
    "accelerators": Cases((), ("device.fem", "device.rods", "device.sdf")),
    "scaling": Cases(("scaling.rod", "scaling.fem", "scaling.batch"), ("scaling.design",)),
}


def quick() -> tuple[str, ...]:
    """One to four cases of every row."""
    return tuple(name for cases in ROWS.values() for name in cases.quick)


def grouped(names: Iterable[str]) -> dict[str, list[str]]:
    """Those of the names that a row has, row by row, and the others at the end."""
    left, groups = list(dict.fromkeys(names)), {}
    for row, cases in ROWS.items():
        if found := [name for name in (*cases.quick, *cases.more) if name in left]:
            groups[row] = found
            left = [name for name in left if name not in found]
    return groups | ({FURTHER: left} if left else {})
