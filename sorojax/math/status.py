"""How a call ended, as a value that passes through every transformation."""

import equinox as eqx


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
        "A state left what its model describes: gas below vacuum, or a rod stretched more than "
        "tenfold. Check units and limits, or take shorter steps."
    )
    unresolved = (
        "The mesh or the nodes do not carry this shape: with twice as many the answer would be "
        "another one. Give more, e.g. `nodes=` of a rod."
    )
    not_converged = (
        "The search did not settle. Apply the load, or move the targets, in steps that start "
        "from the last answer, or raise `max_iterations`."
    )
    out_of_reach = (
        "The targets cannot be met: this is as close as the model comes. Move the targets, "
        "drop one, widen limits, or give more modes or another first guess."
    )
    max_events = (
        "The limit of events was reached. Raise `max_events`, or let the event rest: events "
        "that crowd together without end, as of a ball that comes to rest, need a threshold."
    )
