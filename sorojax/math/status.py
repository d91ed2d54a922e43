"""How a call ended, as a value that passes through every transformation."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from sorojax._jax.trace_state import is_tracer


class Status(eqx.Enumeration):
    """Outcome of a solver; the message says what to do."""

    successful = ""
    max_steps = (
        "The step limit was reached. Raise `max_steps`, loosen `rtol`, or look for a "
        "regulator or a damping that is much faster than the motion of interest."
    )
    not_finite = (
        "A value is not finite. Take shorter steps or a stronger damping, and check that "
        "gains, limits and units are what you meant."
    )
    unstable = (
        "The steps are too long: the errors of single steps add up to as much as the motion, "
        "as beyond the limit of stability of a method. Take shorter steps, or a method for "
        "stiff equations."
    )
    inverted = (
        "Matter is turned inside out: a stretch or a volume is no longer positive. Lower the "
        "load, raise it in steps, or check units and signs."
    )
    outside_model = (
        "A state left what its model describes: gas below vacuum, a rod stretched more than "
        "tenfold, or a trained body strained or touching beyond its training. Check units "
        "and limits, take shorter steps, or train with larger inputs."
    )
    unresolved = (
        "Nodes or steps are too coarse: with twice as many nodes a rod would end elsewhere, or "
        "a step would carry a body through another or give it energy; such a run stays at the "
        "state before that step. Give more `nodes=`, shorter steps, or a stiffer contact: a "
        "body sinks in by about its speed times the root of its mass over the stiffness, "
        "which must be less than it takes to get through."
    )
    not_converged = (
        "The search did not settle. Apply the load, or move the targets, in steps that start "
        "from the last answer, or raise `max_iterations`."
    )
    unstable_equilibrium = (
        "In balance, but not stable: the least push carries it away, as it does a straight "
        "column past its critical load. Start the search from a shape on the side to which it "
        "shall go, or follow the branch by `arc_length_path`."
    )
    out_of_reach = (
        "The targets cannot be met: this is as close as the model comes. Move the targets, "
        "drop one, widen limits, or give more modes or another first guess."
    )
    max_events = (
        "The limit of events was reached. Raise `max_events`, or let the event rest: events "
        "that crowd together without end, as of a ball that comes to rest, need a threshold."
    )
    tangled = (
        "A cell of the moved mesh is inside out: the shape changes by more than the nodes of "
        "its start mesh can follow. Change it less, or mesh the new shape."
    )
    singular = (
        "A pose is singular, or all but: closures lose hold of a motion there, or one of them "
        "no longer does what the others do not, as in a four-bar stretched out. Reactions and "
        "the way out are not determined. Start elsewhere, drive the mechanism through, or give "
        "it another closure."
    )
    not_settled = (
        "The output still moves at the end, as in a limit cycle. Lower the gains or the delay, "
        "raise the damping, or give it more time."
    )
    outside_mesh = (
        "A curve has left the cells that hold its samples. Move it back into the body, or "
        "choose the cells anew."
    )
    too_few_states = (
        "The states hold fewer independent strains than modes are asked for: what is left is "
        "rounding. Ask for fewer modes, load further, or add states."
    )


class _Outcome(type(Status.successful)):  # pyright: ignore[reportGeneralTypeIssues]
    """A status that prints its name, and of several how many there are of each."""

    def __repr__(self) -> str:
        if is_tracer(self._value):
            return "Status(traced)"
        if not isinstance(self._value, jax.Array | np.ndarray | np.generic):
            return "Status(unknown)"  # a tree of something else
        names = list(Status._name_to_item)
        values = np.asarray(self._value)
        if values.ndim == 0:
            return f"Status({names[int(values)]})"
        counts = np.bincount(values.ravel(), minlength=len(names))
        found = [f"{name}: {n}" for name, n in zip(names, counts, strict=True) if n]
        return f"Status({', '.join(found)})"


def _where(pred: Any, a: Any, b: Any) -> Any:
    """`a` where `pred` holds, else `b`."""
    return _Outcome(_plain_where(pred, a, b)._value, Status)


_plain_where = Status.where
Status.where = staticmethod(_where)
for _name, _item in list(Status._name_to_item.items()):
    Status._name_to_item[_name] = _Outcome(_item._value, Status)
