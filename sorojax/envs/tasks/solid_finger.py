"""The planar finger of finite elements that a task reduces, and its training."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check, fem, material, mesh, systems
from sorojax._display import displayed
from sorojax.envs import solids
from sorojax.units import kPa, mm

PORTS = "left", "right"  # loads of the chambers at x < 0 and x > 0
LENGTH = 100 * mm
MAX_PRESSURE = 16 * kPa  # of the default supply
_SEEN = 1.15  # pressures of the training, over that
_SPINE, _DEEP, _WALL = 3 * mm, 4.5 * mm, 3 * mm  # across: spine, chamber, outer wall
_CHAMBERS, _HIGH, _APART, _ROOT = 11, 5 * mm, 3 * mm, 6 * mm  # along
_ACROSS = 20 * mm  # of the plane
_MARKERS = 4
_YOUNG, _POISSON, _DENSITY, _VISCOSITY = 150 * kPa, 0.4, 1070.0, 1000.0  # the last in Pa s
_EQUILIBRIA = 13  # of each path
_HELD, _LAG, _STEP, _CHANGES = 0.14, 0.05, 0.02, 8  # [s] of commands in motions of training
_MOTIONS = 10
_SIZE, _MODES = 1.25 * mm, 20


@displayed
class SolidFinger(eqx.Module):
    """A trained finger: `solid_finger()`.

    Attributes:
        mesh: Of the whole finger.
        reduced: The body in a few shapes, with the force of a few cells.
    """

    mesh: mesh.Mesh
    reduced: systems.SampledBody

    def _text(self) -> str:
        return f"SolidFinger: {self.mesh.num_cells} cells\n  {self.reduced!r}"


def solid_finger(
    size: float = _SIZE, *, modes: int = _MODES, tolerance: float = 4.5e-3, keep: bool = True
) -> SolidFinger:
    """The silicone finger of `SolidReach`, trained once and kept on this computer.

    A planar finger of 100 mm with eleven chambers on each side of a spine, clamped at its
    upper end, in plane strain; neo-Hookean rubber of 150 kPa, with the viscosity of
    `fem.KelvinVoigt`. It is trained on equilibria under either pressure, up to 18 kPa, and on
    motions under both.

    Args:
        size: Of the sides of its cells [m].
        modes: Number of shapes.
        tolerance: Of the choice of cells, as of `systems.sampled_body`.
        keep: Read what an earlier call has kept, and keep what is trained; in
            `$SOROJAX_CACHE/trained`, by default `~/.cache/sorojax/trained`.

    Returns:
        The finger. Reports the progress of a training.

    Raises:
        ValueError: If the size is not positive or there are too few shapes.

    Example:
        >>> small = envs.solid_finger(4 * mm, modes=6, tolerance=0.05, keep=False)
        >>> len(small.reduced.body.basis), small.reduced.body.outputs["reach"].shape
        (6, ())
    """
    _check.positive("solid_finger", "size", size, "m", "1e-3 is that of the task.")
    settings = size, modes, tolerance
    return solids.kept("solid_finger", settings, Path(__file__), _trained, keep)


def full_finger(
    size: float = _SIZE, *, stiffness: float = 1.0, damping: float = 1.0, density: float = 1.0
) -> systems.FemBody:
    """The whole finger, its tip the last marker, with factors of its rubber."""
    cells = finger_mesh(size)
    rubber = material.neo_hookean(
        young_modulus=stiffness * _YOUNG,
        poisson_ratio=_POISSON,
        density=density * _DENSITY,
    )
    lining = _linings(cells)
    loads = [fem.Pressure(facets, name=name) for name, facets in lining.items()]
    problem = fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(_ACROSS),
        supports=(fem.Fixed(cells.node_sets["top"]),),
        loads=(*loads, fem.Gravity()),
    )
    ends = {
        f"marker_{k}": mesh.nearest_node(cells, [0.0, -LENGTH * k / _MARKERS])
        for k in range(1, _MARKERS + 1)
    }
    return systems.FemBody(problem, fem.KelvinVoigt(damping * _VISCOSITY), markers=ends)


def finger_mesh(size: float) -> mesh.Mesh:
    """Triangles of second order between the lines of the drawing, which hangs down from y = 0
    along x = 0."""
    half = np.cumsum([_SPINE / 2, _DEEP, _WALL])
    x = np.concatenate([-half[::-1], half])
    starts = _ROOT + (_HIGH + _APART) * np.arange(_CHAMBERS)
    y = np.concatenate([[0.0], np.stack([starts, starts + _HIGH], axis=1).ravel(), [LENGTH]])
    lines = _divided(x, size), _divided(-y[::-1], size)
    grid = mesh.between_lines(*lines, element=mesh.Tri6())
    middle = np.asarray(grid.points)[np.asarray(grid.cells)[:, :3]].mean(axis=1)
    row, side = np.searchsorted(y, -middle[:, 1]), np.abs(middle[:, 0])
    hollow = (row % 2 == 0) & (side > half[0]) & (side < half[1])
    return mesh.submesh(grid, np.flatnonzero(~hollow))


def _divided(lines: np.ndarray, size: float) -> np.ndarray:
    """`lines` [m] with more between them, about `size` apart."""
    counts = np.maximum(1, np.round(np.diff(lines) / size).astype(int))
    at = zip(lines[:-1], lines[1:], counts, strict=True)
    return np.concatenate(
        [*(np.linspace(a, b, n, endpoint=False) for a, b, n in at), lines[-1:]]
    )


def _linings(cells: mesh.Mesh) -> dict[str, np.ndarray]:
    """Facets of the chambers at each side."""
    facets = mesh.boundary_facets(cells)
    points = np.asarray(cells.points)
    middle = points[facets[:, :2]].mean(axis=1)
    gaps = np.abs(middle[:, None] - np.stack([points.min(axis=0), points.max(axis=0)])[None])
    inside = gaps.min(axis=(1, 2)) > 1e-9
    return {
        name: facets[inside & (sign * middle[:, 0] > 0)]
        for name, sign in zip(PORTS, (-1, 1), strict=True)
    }


def _trained(size: float, modes: int, tolerance: float) -> SolidFinger:
    full = full_finger(size)
    rows = jnp.linspace(0.0, _SEEN * MAX_PRESSURE, _EQUILIBRIA)
    reduced = systems.sampled_body(
        full,
        [{name: rows} for name in PORTS],
        motions=[_motion(full, seed) for seed in range(_MOTIONS)],
        modes=modes,
        tolerance=tolerance,
    )
    return SolidFinger(full.problem.mesh, reduced)


def _motion(full: systems.FemBody, seed: int) -> Float[Array, "frames nodes dim"]:
    """Displacements [m] under commands drawn for both sides, that arrive by a lag."""
    draw = np.random.default_rng(seed)
    wanted = _SEEN * MAX_PRESSURE * draw.integers(0, 5, (_CHANGES, len(PORTS))) / 4
    count = round(_HELD / _STEP)
    pressure = [np.zeros(len(PORTS))]
    for each in np.repeat(wanted, count, axis=0):
        pressure.append(each + (pressure[-1] - each) * np.exp(-_STEP / _LAG))
    given = dict(zip(PORTS, jnp.asarray(np.transpose(pressure)), strict=True))
    duration = (len(pressure) - 1) * _STEP
    return fem.simulate(
        full.problem, duration, _STEP, damping=full.damping, **given
    ).displacements[1::3]
