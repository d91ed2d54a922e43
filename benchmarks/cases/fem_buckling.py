"""Reference case B: the holed square, its critical strain and its force past buckling.

Square of 40 mm with 4 x 4 holes of 8 mm at a pitch of 10 mm, plane strain, E = 19 kPa,
nu = 0.45, glued between plates that approach each other by 12.5 %.
"""

import numpy as np

from benchmarks.harness import Row, measure_calls
from sorojax import fem, material, mesh, sdf
from sorojax.fem.stability.modal import Modes
from sorojax.units import kPa, mm

#: Converged answers of an independent code on uniform six-node triangles down to 0.25 mm:
#: critical strain, and force per depth [N/m] by strain past buckling. That critical strain
#: is where the lowest eigenvalue of the tangent vanishes if it goes on falling as between
#: 7.75 % and 8 %; its mode, the columns leaning to one side, seeds the imperfection.
CRITICAL_STRAIN = 0.0859
BRACKET = (0.0775, 0.08)
NEARBY = (0.081, 0.0835)
FORCES = {0.10: -25.80, 0.125: -26.06}
NOTE = "converged solution of an independent code"
SIDE, CENTRES = 40 * mm, np.array([5, 15, 25, 35]) * mm
IMPERFECTION = 1e-3 * SIDE  # largest entry of the mode added to the nodes


def square() -> mesh.Mesh:
    """Triangles graded to the holes and to the glued corners, mirrored in both middle lines:
    a mesh without symmetry has no bifurcation."""
    half, centres = SIDE / 2, CENTRES[:2]
    holes = [sdf.Circle((x, y), 4 * mm) for x in centres for y in centres]
    shape = sdf.Rectangle((0, 0), (half, half)) - sdf.union(*holes)
    sides = _pairs(np.arange(3) * 10 * mm, centres)  # the columns bend at these necks
    middles = _pairs(centres, centres)

    def size(p):
        off_hole = np.maximum(_distance(p, middles) - 4 * mm, 0)
        off_neck = np.maximum(_distance(p, sides) - 2.5 * mm, 0)
        at_neck = 0.26 * mm + 0.35 * off_hole + 0.12 * off_neck
        at_corner = 0.2 * mm + 0.3 * np.linalg.norm(p, axis=1)
        return np.minimum(np.minimum(at_neck, at_corner), 0.85 * mm)

    quarter = mesh.triangulate(shape, size=size, order=2)
    return mesh.mirror(mesh.mirror(quarter, 0, SIDE / 2), 1, SIDE / 2)


def _pairs(x, y):
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _distance(p, points):
    return np.linalg.norm(p[:, None] - points[None], axis=2).min(axis=1)


def compressed(cells: mesh.Mesh, strain: float) -> fem.Problem:
    """The square between plates `strain` closer."""
    bottom = mesh.nodes_where(cells, lambda p: p[1] < 1e-9)
    top = mesh.nodes_where(cells, lambda p: p[1] > SIDE - 1e-9)
    young, poisson = 19 * kPa, 0.45
    rubber = material.NeoHookean(young / (2 + 2 * poisson), young / (3 - 6 * poisson))
    supports = (fem.Fixed(bottom), fem.Prescribed(top, np.array([0.0, -strain * SIDE])))
    return fem.problem(cells, rubber, kinematics=fem.PlaneStrain(1.0), supports=supports)


def lowest_mode(cells: mesh.Mesh, strain: float) -> Modes:
    """Lowest eigenvalue of the tangent of the perfect structure, and its mode."""
    problem = compressed(cells, strain)
    return fem.tangent_modes(problem, fem.solve(problem, steps=2).displacement)


def buckled_forces(cells: mesh.Mesh, shape) -> dict[float, float]:
    """Force on the upper plate [N] past buckling, at the strains of the reference."""
    largest = max(FORCES)
    problem = fem.with_imperfection(compressed(cells, largest), shape, IMPERFECTION)
    path = fem.continuation(problem, step=0.2, locate_critical_points=False)
    forces = {}
    for strain in FORCES:
        near = int(np.abs(np.asarray(path.factors) - strain / largest).argmin())
        here = compressed(problem.mesh, strain)
        u = fem.solve(here, start=path.displacements[near]).displacement
        forces[strain] = float(fem.reaction_force(here, u, here.supports[1].nodes)[1])
    return forces


def rows():
    cells = square()
    problem = compressed(cells, 0.125)
    settings = {"dof": problem.space.num_dofs, "solver": problem.space.system.solver.name}
    modes = [lowest_mode(cells, strain) for strain in BRACKET]
    values = [float(m.eigenvalues[0]) for m in modes]
    (first, second), (before, after) = BRACKET, values
    strain = first + (second - first) * before / (before - after)
    yield _row(settings, "critical strain, extrapolated", strain, CRITICAL_STRAIN)
    forces = buckled_forces(cells, modes[0].shapes[0])
    for compression, wanted in FORCES.items():
        quantity = f"force at {100 * compression:g} % [N/m]"
        yield _row(settings, quantity, forces[compression], wanted)

    def path():
        return fem.continuation(problem, step=0.2, until=lambda _, factor: factor > 0.7)

    paths = []
    timing = measure_calls(lambda: paths.append(path()) or paths[-1].displacements, repeats=1)
    found = paths[-1]
    located = [0.125 * float(point.factor) for point in found.critical_points]
    yield Row(
        "sorojax",
        settings
        | {
            "quantity": "first bifurcations, located on the path",
            "value": located,
            "iterations": found.stats.iterations,
        },
        **timing.columns(),
        reference="",
    )
    first, second = zeros(cells)
    yield _row(
        settings, "critical strain, columns leaning, from nearby", second, CRITICAL_STRAIN
    )
    yield Row(
        "sorojax",
        settings
        | {
            "quantity": "critical strain, ellipses: the square leaves its path here",
            "value": first,
        },
        error=first / second,
        bar=1.0,
        bar_on="error",
        reference="own; over that of the leaning columns",
    )


def zeros(cells: mesh.Mesh) -> tuple[float, float]:
    """Strains at which the eigenvalues of the ellipses and of the leaning columns vanish, by a
    line through two strains just short of both."""
    found = []
    for strain in NEARBY:
        problem = compressed(cells, strain)
        modes = fem.tangent_modes(problem, fem.solve(problem, steps=2).displacement, 2)
        pairs = zip(map(leans, modes.shapes), modes.eigenvalues.tolist(), strict=True)
        found.append([value for _, value in sorted(pairs)])  # ellipses do not lean
    before, after = np.array(found)
    low, high = (NEARBY[0] + (NEARBY[1] - NEARBY[0]) * before / (before - after)).tolist()
    return low, high


def leans(shape) -> bool:
    """Whether a mode shifts all columns to one side; that of the ellipses, neighbouring holes
    across and along, shifts none on the whole."""
    aside = np.asarray(shape)[:, 0]
    return bool(abs(aside.mean()) > 0.5 * np.abs(aside).mean())


def _row(settings: dict, quantity: str, value: float, wanted: float) -> Row:
    return Row(
        "sorojax",
        settings | {"quantity": quantity, "value": value},
        reference=f"{NOTE}: {wanted}",
        error=abs(value / wanted - 1),
        bar=5e-3,
        bar_on="error",
    )
