"""Values to colour a body by: fields known by name, functions and arrays, with units."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax.fem import Problem
from sorojax.mesh import Mesh, cell_areas, cell_volumes

NodalField = Callable[[Problem, Float[Array, "nodes dim"]], Float[Array, " nodes"]]
Field = str | NodalField | Float[Any, " values"] | None


class Coloured(NamedTuple):
    """Values per node or per cell in SI units, their name, and what they are measured in."""

    values: Float[np.ndarray, " values"]
    name: str
    unit: str


@eqx.filter_jit
def nodal_von_mises(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, " nodes"]:
    """Von Mises stress at the nodes, averaged between cells [kPa]."""
    return fem.nodal_average(problem, fem.von_mises_stress(problem, u)) / 1e3


@eqx.filter_jit
def _mean_stress(problem: Problem, u) -> Float[Array, " nodes"]:
    sigma = fem.cauchy_stress(problem, u)
    return fem.nodal_average(problem, jnp.trace(sigma, axis1=-2, axis2=-1) / 3)


@eqx.filter_jit
def _largest_stretch(problem: Problem, u) -> Float[Array, " nodes"]:
    F = fem.deformation_gradient(problem, u)
    C = jnp.swapaxes(F, -1, -2) @ F
    return fem.nodal_average(problem, jnp.sqrt(jnp.linalg.eigvalsh(C)[..., -1]))


def _energy_density(problem: Problem, u) -> Float[np.ndarray, " cells"]:
    mesh = problem.mesh
    size = cell_areas(mesh) if mesh.element.dim == 2 else cell_volumes(mesh)
    depth = getattr(problem.kinematics, "thickness", 1.0)
    return np.asarray(fem.strain_energy(problem, u)) / np.asarray(size * depth)


_NAMED: dict[str, tuple[str, str, Callable[..., Any]]] = {
    "von_mises": ("von Mises stress", "Pa", lambda p, u: 1e3 * nodal_von_mises(p, u)),
    "pressure": ("mean stress", "Pa", _mean_stress),
    "displacement": ("displacement", "m", lambda p, u: jnp.sqrt(jnp.sum(u**2, axis=1))),
    "x": ("displacement along x", "m", lambda p, u: u[:, 0]),
    "y": ("displacement along y", "m", lambda p, u: u[:, 1]),
    "z": ("displacement along z", "m", lambda p, u: u[:, 2]),
    "stretch": ("largest stretch", "-", _largest_stretch),
    "energy": ("strain energy density", "J/m^3", _energy_density),
}


def evaluate(
    problem: Problem, u: Float[Array, "nodes dim"], field: Field, label: str = ""
) -> Coloured | None:
    """The field of a body at displacement `u` [m].

    Args:
        problem: The body.
        u: Displacement of its nodes.
        field: "von_mises", "pressure" (mean stress, tension positive), "displacement", "x",
            "y", "z", "stretch", "energy"; `field(problem, u)` or an array, one value per
            node or per cell; None for no field.
        label: Name and unit of a function or an array.

    Raises:
        ValueError: If there is no field of that name.
    """
    if field is None:
        return None
    if isinstance(field, str):
        if field not in _NAMED:
            raise ValueError(
                f"view: got field={field!r}, need one of {', '.join(_NAMED)}, a function of "
                "(problem, u), or an array."
            )
        name, unit, function = _NAMED[field]
        return Coloured(np.asarray(function(problem, u)), label or name, "" if label else unit)
    values = field(problem, u) if callable(field) else field
    return Coloured(np.asarray(values), label, "")


_STEPS = {
    "Pa": ((1e6, "MPa"), (1e3, "kPa"), (1.0, "Pa")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "um")),
    "J/m^3": ((1e6, "MJ/m$^3$"), (1e3, "kJ/m$^3$"), (1.0, "J/m$^3$")),
}


def readable(rows: list[Coloured]) -> tuple[list[np.ndarray], str]:
    """The values of all rows in one unit that gives short numbers, and the label."""
    first = rows[0]
    if first.unit not in _STEPS:
        unit = f" [{first.unit}]" if first.unit else ""
        return [row.values for row in rows], f"{first.name}{unit}"
    flat = np.concatenate([np.ravel(row.values) for row in rows])
    largest = float(np.max(np.abs(flat[np.isfinite(flat)]), initial=0.0))
    factor, unit = _step(largest / 2, first.unit)
    return [row.values / factor for row in rows], f"{first.name} [{unit}]"


def short(value: float, unit: str) -> str:
    """A number with its unit: 12500 Pa as `12.5 kPa`."""
    factor, name = _step(abs(value), unit) if unit in _STEPS else (1.0, unit)
    return f"{value / factor:.3g} {name}".strip()


def _step(value: float, unit: str) -> tuple[float, str]:
    """The largest unit of which `value` has at least one, its size first."""
    steps = _STEPS[unit]
    return next((s for s in steps if value >= s[0]), steps[-1] if value else steps[1])


def mesh_quality(mesh: Mesh) -> Float[np.ndarray, " cells"]:
    """Shape number of every cell in [0, 1], as in `mesh.quality`; 1 is the best."""
    from sorojax.mesh.quality import cell_ratios

    return cell_ratios(mesh)
