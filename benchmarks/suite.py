"""What the report compares, row by row, and which cases show a row in little time."""

ROWS = {
    "rod statics": ("rod.statics",),
    "rod dynamics": ("rod.acceleration", "rod.simulation"),
    "rod batches": ("rod.batch",),
    "FEM assembly": ("fem.assembly",),
    "FEM equilibrium": ("fem.case_a",),
    "near incompressibility": ("fem.cook",),
    "buckling": ("fem.buckling",),
    "FEM dynamics with contact": ("fem.friction",),
    "SDF evaluation and surfaces": ("sdf.value", "sdf.surface"),
    "meshing": ("mesh.triangulate", "mesh.tetrahedralise"),
    "topology optimisation": ("design.layout",),
    "system integration": ("systems.easy", "systems.stiff"),
    "inverse kinematics and estimator": ("rod.ik", "systems.estimator"),
    "gradients": ("fem.gradient",),
    "start": ("cli.import", "rod.first_call"),
}


def quick() -> tuple[str, ...]:
    """One or two cases of every row."""
    return tuple(name for names in ROWS.values() for name in names)
