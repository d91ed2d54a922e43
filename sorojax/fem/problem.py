"""The boundary value problem: a noun, and the constructor that checks it."""

import equinox as eqx

from sorojax import _check
from sorojax.fem import checks, checks_loads
from sorojax.fem.formulation import AbstractFormulation, default_formulation
from sorojax.fem.kinematics import AbstractKinematics, Solid
from sorojax.fem.loads import AbstractLoad
from sorojax.fem.space import Space, space as make_space
from sorojax.fem.supports import AbstractSupport
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.mesh.mesh import Mesh


class Problem(eqx.Module):
    """A hyperelastic body, how it is held and what loads it.

    Every number in it can carry a gradient; print it to see what is paid for.
    """

    mesh: Mesh
    material: AbstractHyperelastic
    kinematics: AbstractKinematics
    supports: tuple[AbstractSupport, ...]
    loads: tuple[AbstractLoad, ...]
    formulation: AbstractFormulation
    space: Space

    def __repr__(self) -> str:
        held = ", ".join(f"{type(s).__name__}({s.nodes.size} nodes)" for s in self.supports)
        loads = ", ".join(f"{type(load).__name__} '{load.name}'" for load in self.loads)
        return (
            f"Problem({self.mesh.element.name}: {self.mesh.num_cells} cells, "
            f"{self.space.num_dofs} dof; {type(self.formulation).__name__}; "
            f"{type(self.material).__name__}; {type(self.kinematics).__name__}; "
            f"supports: {held}; loads: {loads or 'none'})"
        )


def problem(
    mesh: Mesh,
    material: AbstractHyperelastic,
    *,
    kinematics: AbstractKinematics | None = None,
    supports: tuple[AbstractSupport, ...],
    loads: tuple[AbstractLoad, ...] = (),
    formulation: AbstractFormulation | None = None,
    space: Space | None = None,
) -> Problem:
    """A checked boundary value problem.

    Args:
        mesh: Cells in the reference configuration; points may be traced, cells not.
        material: Stored energy; its leaves are numbers or arrays with one entry per cell.
        kinematics: `PlaneStrain(thickness)`, `PlaneStress(thickness)` or `Axisymmetric()`
            for a plane mesh; `Solid()`, the default, in space.
        supports: `Fixed(nodes)`, `Prescribed(nodes, displacement)`, `Rotated(...)`.
        loads: `Pressure`, `Traction`, `Force`, `Torque`, `Gravity`, `Spring`, `Foundation`,
            `Tendon`, `Cable`, `Contact` and `rigid(mesh, nodes)`.
        formulation: How the pressure varies in a cell. When omitted `LinearPressure()` for
            Tri7, Quad9 and Tet15, `ConstantPressure()` for Quad4, Hex8 and polygons, and
            `Displacement()` for the rest and in plane stress.
        space: The mesh's `space(mesh, loads)`, to share between problems on the same
            topology.

    Raises:
        ValueError: If the body could move rigidly, a set is empty, a cell is inverted, the
            material does not fit the mesh, the formulation would lock or oscillate, or a
            pressure acts on an open run of facets.
    """
    _check.float64("fem.problem", mesh.points)
    supports, loads = tuple(supports), tuple(loads)
    kinematics = checks.kinematics(mesh, kinematics if mesh.element.dim == 2 or kinematics
                                   else Solid())  # fmt: skip
    checks.cells(mesh)
    checks.material(mesh, material)
    if formulation is None:
        formulation = default_formulation(mesh.element, kinematics)
        checks.locking(mesh, material, kinematics, formulation)
    checks.formulation(mesh, kinematics, formulation)
    known = checks.supports(mesh, kinematics, supports)
    checks_loads.sets(mesh, loads)
    loads = tuple(load.completed(mesh, material, kinematics) for load in loads)
    checks_loads.loads(mesh, kinematics, material, loads, known)
    if space is None:
        space = make_space(mesh, loads)
    else:
        checks.space(mesh, space)
        checks_loads.room(space, loads)
    made = Problem(mesh, material, kinematics, supports, loads, formulation, space)
    checks.held(made, known)
    return made
