"""An assembly that carries reduced solids on its links, as one block.

A solid in a few shapes moves with the frame of a link (floating frame of reference). Its modal
coordinates and those of the assembly accelerate together: the mass matrix of the whole is that
of the assembly, with what the solid adds to the link that carries it. As the shapes are of unit
modal mass, the modal accelerations are eliminated without a factorisation, and the cost beyond
that of the assembly grows with the number of shapes alone.

Reference:
    Shabana, Dynamics of Multibody Systems, 2013, chapter 5, for the equations.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.rod import Link
from sorojax.rod.dynamics.tree import (
    AssemblyState,
    Frame,
    bias_accelerations,
    part_columns,
)
from sorojax.rod.model.assembly import index_of, rate
from sorojax.systems.blocks.block import AbstractBlock, Output, first_defect
from sorojax.systems.blocks.modal_body import ModalBody
from sorojax.systems.blocks.modal_inertia import ModalInertia
from sorojax.systems.blocks.rod_body import AssemblyBody

_PLANAR = (2, 3, 4)  # of a twist in space: about z, along x and y


class _Share(NamedTuple):
    """What a solid adds to its link, along the axes of the link: its acceleration A gives the
    wrench `inertia` A + `wrench` on the solid, and the modal ones `pull` - `coupling`' A."""

    inertia: Float[Array, "twist twist"]
    wrench: Float[Array, " twist"]
    coupling: Float[Array, "twist modes"]
    pull: Float[Array, " modes"]
    columns: Float[Array, "twist dof"]
    bias: Float[Array, " twist"]


class CarryingBody(AbstractBlock):
    """An assembly with reduced solids fixed to its links; the state is that of the assembly,
    and {q, v} of each solid by the name of its link.

    Ports are those of the assembly; and those of each solid, named after the link that carries
    it: a solid with the input `air_pressure` on the link `palm` opens `palm_air_pressure`, and
    a marker `tip` the output `palm_tip_position` in the world. `palm_wrench` is what the link
    exerts on the solid, about the frame of the link, moment [N m] first, along the axes of the
    world. The weight of the solid is that of its problem, in the world.

    A step takes a hundredth of that of a `FemBody` with the same support wired to the assembly
    (a bellows of 886 cells), and any method integrates it.

    Attributes:
        arm: The assembly with its forces. A rod carries a solid by a link on its tip, which may
            have no mass: `rod.Part(rod.Link(0.0, 0.0), on="finger")`.
        solids: Reduced solids by the name of the link: of `modal_body` or `sampled_body`, of a
            `FemBody` whose one support is `fem.Carried`.

    Raises:
        ValueError: If a solid is on a part that is no link, has other supports than the
            frame that carries it, or the assembly is of another dimension.

    Example:
        >>> cells = mesh.rectangle([0, 0], [60 * mm, 10 * mm], divisions=(6, 1))
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4, density=1000)
        >>> root = cells.node_sets["left"]
        >>> problem = fem.problem(
        ...     cells, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Carried(root, cells.points[root], name="grip"),))
        >>> body = systems.FemBody(problem, driven=("grip",))
        >>> bar = rod.Link(0.1, 1e-4, [-50 * mm, 0.0])
        >>> arm = rod.assembly(SE2(), bar=rod.Part(bar, rod.Revolute()))
        >>> small = systems.modal_body(body, systems.modal_basis(body, 3))
        >>> whole = systems.CarryingBody(
        ...     systems.AssemblyBody(arm, (rod.Gravity(),)), {"bar": small})
        >>> film = systems.simulate(
        ...     systems.Network({"arm": whole}, {}), 0.1, solver=systems.Rodas4(), step=1e-3)
        >>> bool(film.state["arm"]["q"][-1, 0] > 0)
        True
    """

    arm: AssemblyBody
    solids: dict[str, ModalBody]

    def __check_init__(self):
        assembly = self.arm.assembly
        for name, solid in self.solids.items():
            part = assembly.parts[index_of(assembly, name)]
            if not isinstance(part.body, Link):
                raise ValueError(
                    f"CarryingBody: `{name}` is a rod, need a link. Fix one without mass to "
                    f"its tip: rod.Part(rod.Link(0.0, 0.0), on={name!r})."
                )
            if solid.inertia is None:
                raise ValueError(
                    f"CarryingBody: the solid on `{name}` is fixed to the ground, need one "
                    "whose one support is a driven fem.Carried. Reduce FemBody(problem, "
                    "driven=(its name,))."
                )
            if solid.force.relaxation_times is not None:
                raise ValueError(
                    f"CarryingBody: the solid on `{name}` relaxes, need one without memory. "
                    "Reduce a body of the `base` of its material."
                )
            dim = solid.basis.displacement.shape[1]
            if dim != assembly.group.space_dim:
                raise ValueError(
                    f"CarryingBody: the solid on `{name}` is of {dim} dimensions, need "
                    f"{assembly.group.space_dim} as the assembly."
                )
        ports = [*self.arm.inputs, *self._driven(), *self.arm.outputs, *self._told()]
        names = [*ports, *self.arm.initial_state(), *self.solids]
        if twice := {name for name in names if names.count(name) > 1} - {"q"}:
            raise ValueError(
                f"CarryingBody: {min(twice)} is the name of two ports or states. Rename the "
                "part, or the closure, load or marker."
            )

    @property
    def inputs(self):
        return self.arm.inputs | self._driven()

    def _driven(self):
        return {
            f"{part}_{name}": port
            for part, solid in self.solids.items()
            for name, port in solid.inputs.items()
        }

    @property
    def outputs(self):
        return self.arm.outputs | self._told()

    def _told(self):
        felt, twist = frozenset(self.inputs), self.arm.assembly.group.algebra_dim
        ports = {}
        for part, solid in self.solids.items():
            ports |= {f"{part}_{name}": port for name, port in solid.outputs.items()}
            ports[f"{part}_wrench"] = Output(None, (twist,), felt)
        return ports

    def initial_state(self):
        own = {part: solid.initial_state() for part, solid in self.solids.items()}
        return {**self.arm.initial_state(), **own}

    def output(self, name, t, state, inputs):
        if name in self.arm.outputs:
            return self.arm.output(name, t, state, inputs)
        part = next(p for p in self.solids if name.removeprefix(f"{p}_") in self._of(p))
        kind, solid = name.removeprefix(f"{part}_"), self.solids[part]
        own, at = state[part], index_of(self.arm.assembly, part)
        if kind == "wrench":
            return self._solved(t, state, inputs)[2][part]
        if kind in ("q", "reach", "elastic_energy", *(n for _, *v in solid.volumes for n in v)):
            return solid.output(kind, t, own, self._taken(part, inputs))
        frame = self.arm.moment(state).frames[at]
        assert solid.inertia is not None
        if kind == "kinetic_energy":
            rows = _rows(frame.rotation.shape[0])
            twist = jnp.zeros(6, own["q"].dtype).at[rows].set(frame.twist)
            return solid.inertia.kinetic_energy(own["q"], own["v"], twist)
        inside = solid.output(kind, t, own, self._taken(part, inputs))
        return frame.position + frame.rotation @ solid.inertia.in_frame(inside)

    def vector_field(self, t, state, inputs):
        rates, modal, _ = self._solved(t, state, inputs)
        return {**rates, **modal}

    def path_status(self, path):
        own = (solid.path_status(path[part]) for part, solid in self.solids.items())
        return first_defect((self.arm.path_status(path), *own))

    def _of(self, part: str) -> set[str]:
        return {*self.solids[part].outputs, "wrench"}

    def _taken(self, part: str, inputs) -> dict[str, Array]:
        own = self.solids[part].inputs
        return {name: inputs[f"{part}_{name}"] for name in own if f"{part}_{name}" in inputs}

    def _solved(self, t, state, inputs):
        """Rates of the assembly and of the solids, and the wrenches on these in the world."""
        shares: dict[str, _Share] = {}

        def added(moment: AssemblyState):
            columns, biases = part_columns(moment), bias_accelerations(moment)
            mass, force = 0.0, 0.0
            for part, solid in self.solids.items():
                at, taken = index_of(self.arm.assembly, part), self._taken(part, inputs)
                link = moment.frames[at], columns[at], biases[at]
                one = _share(solid, state[part], taken, *link)
                mass = mass + one.columns.T @ one.inertia @ one.columns
                force = force - one.columns.T @ (one.inertia @ one.bias + one.wrench)
                shares[part] = one
            return mass, force

        moment, a, _, rates = self.arm.solved(t, state, inputs, added)
        modal, wrenches = {}, {}
        for part, one in shares.items():
            moved = one.columns @ a + one.bias
            v = state[part]["v"]
            modal[part] = {"q": v, "v": one.pull - one.coupling.T @ moved}
            turn = moment.frames[index_of(self.arm.assembly, part)].rotation
            rot = turn.shape[0] * (turn.shape[0] - 1) // 2
            wrench = one.inertia @ moved + one.wrench
            torque = wrench[:rot] if rot == 1 else turn @ wrench[:rot]
            wrenches[part] = jnp.concatenate([torque, turn @ wrench[rot:]])
        v = state["v"]
        return {"q": rate(self.arm.assembly, state["q"], v), "v": a} | rates, modal, wrenches


def _rows(dim: int) -> np.ndarray:
    """Entries of a twist in space that one in `dim` dimensions has."""
    return np.array(_PLANAR if dim == 2 else range(6))


def _share(solid: ModalBody, own, inputs, frame: Frame, columns, bias) -> _Share:
    """Of a solid in a state `own` on a link with this frame, whose twist has these `columns`
    and whose acceleration is `bias` where that of the coordinates is zero."""
    inertia, rows = solid.inertia, _rows(len(frame.position))
    assert isinstance(inertia, ModalInertia)
    twist = jnp.zeros(6, own["q"].dtype).at[rows].set(frame.twist)
    whole = inertia.moved(own["q"], own["v"], twist[:3])
    coupling = whole.coupling[rows]
    # as seen from a frame that accelerates against gravity, nothing has weight
    weight = jnp.zeros_like(frame.twist).at[-len(frame.position) :]
    weight = weight.set(frame.rotation.T @ inertia.gravity)
    left = whole.matrix[rows][:, rows] - coupling @ coupling.T
    pull = solid.pull(own["q"], own["v"], inputs) - whole.swing
    wrench = whole.wrench[rows] + coupling @ pull - left @ weight
    bias = jnp.zeros_like(frame.twist) if bias is None else bias
    return _Share(left, wrench, coupling, pull + coupling.T @ weight, columns, bias)
