"""Rods of the printable robots against solids of the same body: bellows, bending actuator.

The bellows whole as a body of revolution, the actuator in space, half of it, on tetrahedra
that follow its walls; both with large strains. The rods take their numbers from one cell,
that of the bellows with what it stores to the fourth order in stretch and pressure.
"""

import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import fem, mesh, rod, sdf
from sorojax.math.lie import SE2
from sorojax.mesh.elements.simplex import Tet10
from sorojax.robots import Bellows, BendingActuator, printed_rubber, unit_cell
from sorojax.robots.models.cell import bellows_cell
from sorojax.robots.models.rods import Body, body, column, side_by_side
from sorojax.units import kPa, mm

BAR = 0.05
PRESSURES = np.array([5.0, 10.0, 20.0, 30.0]) * kPa


def rows():
    for name, study, pressures in (
        ("bellows, change of length", bellows, np.append(PRESSURES, 50 * kPa)),
        ("bending actuator, turn of the tip", bending, PRESSURES),
    ):
        solid, found = study(pressures)
        for pressure, true, got in zip(pressures, solid, found, strict=True):
            settings = {
                "what": name,
                "pressure": f"{pressure / kPa:g} kPa",
                "solid": true,
                "rod": got,
            }
            yield Row(
                "sorojax",
                settings,
                error=abs(got / true - 1),
                bar=BAR,
                bar_on="error",
                reference="fem.solve_path of the whole body",
            )


def bellows(pressures) -> tuple[np.ndarray, np.ndarray]:
    """Elongation [-] between the caps, of the solid and of the cell."""
    part, rubber, wide = Bellows(), printed_rubber(), 50 * mm
    profile = part._profile()
    gas = sdf.offset(profile, -part.wall_thickness) & sdf.Rectangle(
        [-wide, part.cap], [wide, part.length - part.cap]
    )
    # without the outer halves of its caps, which are plates in the robots
    low, high = part.cap / 2, part.length - part.cap / 2
    right = sdf.Rectangle([0.0, low], [wide, high])
    shape = (profile - gas) & right
    cells = mesh.enrich(mesh.triangulate(shape, size=0.6 * mm, order=2))
    foot = fem.Fixed(mesh.nodes_where(cells, lambda x: x[1] < low + 1e-9))
    axis = fem.Fixed(mesh.nodes_where(cells, lambda x: x[0] < 1e-9), components=(0,))
    air = fem.Pressure(mesh.facets_on(cells, gas & right, 0.1 * mm), name="air")
    problem = fem.problem(
        cells, rubber, kinematics=fem.Axisymmetric(), supports=(foot, axis), loads=(air,)
    )
    path = fem.solve_path(problem, air=jnp.asarray(pressures))
    ends = [
        mesh.nearest_node(cells, [0.0, float(z)]) for z in (part.cap, part.length - part.cap)
    ]
    moved = np.asarray(path.displacements)[:, ends, 1]
    solid = (moved[:, 1] - moved[:, 0]) / float(part.num_folds * part.pitch)
    cell = bellows_cell(part, rubber)
    made = body(
        SE2(),
        rod.constant("sigma_x"),
        side_by_side(cell, jnp.zeros((1, 2)), 1.0),
        1.0,
        rubber,
        damping=0.0,
        single=False,
    )
    return solid, np.array([float(_rest(made, jnp.full(1, p))[0]) for p in pressures])


def _rest(made: Body, pressure):
    return rod.equilibrium(
        made.rod, (made.forces[0], rod.Pressurised(made.chambers, pressure))
    ).q


def bending(pressures) -> tuple[np.ndarray, np.ndarray]:
    """Turn [rad] of the free end of six bellows, of the solid and of the rod. Fillets are
    left out and the channel is square, in both."""
    part, rubber = BendingActuator(num_bellows=6, fillet=1e-6), printed_rubber()
    solid, air = _boxes(part)
    cells = mesh.enrich(_tetrahedra(part, solid))
    wall = fem.Fixed(mesh.nodes_where(cells, lambda x: x[0] < 1e-9))
    plane = fem.Fixed(mesh.nodes_where(cells, lambda x: x[1] < 1e-9), components=(1,))
    inside = mesh.facets_on(cells, air, 1e-6)
    problem = fem.problem(
        cells, rubber, supports=(wall, plane), loads=(fem.Pressure(inside, name="air"),)
    )
    path = fem.solve_path(problem, air=jnp.asarray(pressures))
    length = float(part.length)
    low, high = (mesh.nearest_node(cells, [length, 0.0, z]) for z in (0.0, float(part.base)))
    points = np.asarray(cells.points)[None] + np.asarray(path.displacements)
    across = points[:, high] - points[:, low]
    turned = np.arctan2(across[:, 0], across[:, 2])
    pitch = float(part.pitch)
    cell = unit_cell(
        solid,
        air,
        (1.5 * pitch, 2 * pitch),
        rubber,
        size=float(part.wall_thickness) / 2,
        mirrors=(1,),
    )
    made = body(
        SE2(),
        rod.chebyshev(kappa_z=3, sigma_x=1),
        column(cell),
        length - pitch,
        rubber,
        damping=0.0,
        plane=2,
    )
    turns = [rod.tip_angle(rod.motion(made.rod, _rest(made, p))) for p in pressures]
    return turned, -np.array(turns, float)


def _boxes(part: BendingActuator) -> tuple[sdf.AbstractSdf, sdf.AbstractSdf]:
    """The actuator and its air from boxes alone."""
    w, side, r = (float(x) for x in (part.wall_thickness, part.width / 2, part.channel_radius))
    first = sdf.Box(
        [float(part.gap) / 2 + w, w - side, float(part.base) + w],
        [float(part.pitch - part.gap / 2) - w, side - w, float(part.height) - w],
    )
    step, low = [float(part.pitch), 0.0, 0.0], float(part.base) + w
    rooms = sdf.repeat(first, step, part.num_bellows, separate=True)
    end = float(part.length - part.pitch / 2)
    air = rooms | sdf.Box([step[0] / 2, -r, low], [end, r, low + 2 * r])
    return part.solid() - air, air


def _tetrahedra(part: BendingActuator, solid: sdf.AbstractSdf) -> mesh.Mesh:
    """Quadratic tetrahedra between planes through every wall, half of the actuator."""
    w, g, r = float(part.wall_thickness), float(part.gap) / 2, float(part.channel_radius)
    pitch, side, base = float(part.pitch), float(part.width) / 2, float(part.base)
    one = np.array([0.0, g, g + w, pitch / 2, pitch - g - w, pitch - g])
    x = np.concatenate(
        [one + k * pitch for k in range(part.num_bellows)] + [[pitch * part.num_bellows]]
    )
    y = np.array([0.0, r, side / 2, 0.67 * side, side - w, side])
    top = base + 2 * (w + r)
    z = np.array([0.0, base / 2, base, base + w, base + w + 2 * r, top, 12 * mm, 14.5 * mm,
                  float(part.height) - w, float(part.height)])  # fmt: skip
    lines = (x, y, z)
    counts = (len(x) - 1, len(y) - 1, len(z) - 1)
    grid = mesh.box([0.0] * 3, [float(n) for n in counts], divisions=counts, element=Tet10())
    at = np.asarray(grid.points)
    points = np.stack(
        [np.interp(at[:, k], np.arange(len(line)), line) for k, line in enumerate(lines)],
        axis=1,
    )
    cells = np.asarray(grid.cells)
    middle = points[cells[:, :4]].mean(axis=1)
    kept = cells[np.asarray(sdf.evaluate(solid, jnp.asarray(middle))) < 0]
    used, number = np.unique(kept, return_inverse=True)
    return mesh.Mesh(points[used], number.reshape(kept.shape), Tet10())
