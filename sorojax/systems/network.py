"""A network of blocks is a block: wired, checked and ordered before it runs."""

from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax._display import displayed
from sorojax.systems.blocks.block import AbstractBlock, Input, Output, Signals, first_defect
from sorojax.systems.schedule import (
    check_wires,
    consistent,
    evaluation_order,
    needed,
    reachable_inputs,
    torn_wires,
)


def _pairs(wires: Mapping[str, str] | tuple) -> tuple[tuple[str, str], ...]:
    items = wires.items() if isinstance(wires, Mapping) else wires
    return tuple(sorted((str(a), str(b)) for a, b in items))


@displayed
class Network(AbstractBlock):
    """Blocks side by side, their inputs wired to outputs: x' = f(t, x, u) for all of them.

    The state is one dictionary entry per block. Wiring decides what is computed: an output
    that nothing reads costs nothing. A network is a block itself.

    Attributes:
        blocks: Blocks by name.
        wires: `{"block.input": "block.output"}`, of equal unit and shape; an input has one
            driver.
        exposed: Inputs that the user of the network supplies, `("block.input", ...)`; none by
            default.
        solve_loops: Solve algebraic loops at every evaluation instead of refusing them.

    Raises:
        ValueError: If a name is unknown, an input has no driver or two, units or shapes do not
            fit, or there is an algebraic loop and `solve_loops` is off.
        TypeError: If the ports of a block are no dict.

    Example:
        >>> network = systems.Network(
        ...     {"valve": systems.Lag(0.1), "tube": systems.Lag(0.02)},
        ...     wires={"tube.a": "valve.value"}, exposed=("valve.a",))
        >>> sorted(network.outputs)
        ['tube.value', 'valve.value']
    """

    blocks: dict[str, AbstractBlock]
    wires: tuple[tuple[str, str], ...] = eqx.field(static=True, converter=_pairs)
    exposed: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())
    solve_loops: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_wires(self.blocks, dict(self.wires), self.exposed)
        if not self.solve_loops:
            evaluation_order(self.blocks, dict(self.wires))

    @property
    def inputs(self) -> dict[str, Input]:
        return {name: self.input_ports[name] for name in self.exposed}

    @property
    def outputs(self) -> dict[str, Output]:
        needs = reachable_inputs(self.blocks, dict(self.wires), self.exposed)
        return {
            f"{owner}.{name}": port._replace(needs=needs[f"{owner}.{name}"])
            for owner, block in self.blocks.items()
            for name, port in block.outputs.items()
        }

    @property
    def input_ports(self) -> dict[str, Input]:
        """Every input of every block, by full name."""
        return {
            f"{owner}.{name}": port
            for owner, block in self.blocks.items()
            for name, port in block.inputs.items()
        }

    def initial_state(self) -> dict[str, PyTree]:
        state = {name: block.initial_state() for name, block in self.blocks.items()}
        for name, part in state.items():
            if isinstance(part, tuple) and not part:  # diffrax cannot save an empty tuple
                raise ValueError(
                    f"Network: the initial state of `{name}` is (). A block without memory "
                    "has the state {}, and returns {} from its vector field."
                )
        return state

    def output(self, name, t, state, inputs):
        return _signals(self, t, state, inputs, [name])[name]

    def vector_field(self, t, state, inputs: Signals | None = None) -> dict[str, PyTree]:
        return rates_of(self, t, state, inputs or {}, tuple(self.blocks))

    def path_status(self, path):
        return first_defect(b.path_status(path[name]) for name, b in self.blocks.items())

    def _text(self) -> str:
        rows = [f"Network: {len(self.blocks)} blocks, {len(self.wires)} wires"]
        rows += [f"  {name}: {type(block).__name__}" for name, block in self.blocks.items()]
        rows += [f"  {source} -> {target}" for target, source in self.wires]
        rows += [f"  from outside -> {target}" for target in self.exposed]
        return "\n".join(rows)


def outputs(
    network: Network, t: Float[Array, ""], state: PyTree, inputs: Signals | None = None
) -> dict[str, Array]:
    """Every output of every block at one moment, `{"block.output": value}`.

    Args:
        network: The network, or any block.
        t: Time [s].
        state: Of the network.
        inputs: Values of free inputs by name.

    Returns:
        Values by "block.output".
    """
    names = list(network.outputs)
    signals = _signals(network, t, state, inputs or {}, names)
    return {name: signals[name] for name in names}


def rates_of(
    network: Network, t, state: PyTree, inputs: Signals, names: tuple[str, ...]
) -> dict[str, PyTree]:
    """Rates of the blocks called `names` alone."""
    own = inputs_of(network, t, state, inputs, names)
    rates = {}
    for name in names:
        rates[name] = network.blocks[name].vector_field(t, state[name], own[name])
        _check_rate(network, name, state[name], rates[name])
    return rates


def _check_rate(network: Network, name: str, state: PyTree, rate: PyTree) -> None:
    """Refuse a rate of another structure than its state: integrators pair leaves by place."""
    want, got = jax.tree.leaves_with_path(state), jax.tree.leaves_with_path(rate)
    if [(path, jnp.shape(x)) for path, x in want] == [(p, jnp.shape(x)) for p, x in got]:
        return
    shapes = {jax.tree_util.keystr(path): jnp.shape(x) for path, x in want}
    rates = {jax.tree_util.keystr(path): jnp.shape(x) for path, x in got}
    kind = type(network.blocks[name]).__name__
    where = f"Network: `vector_field` of the block `{name}` ({kind})"
    for leaf in (*shapes, *rates):
        if leaf not in rates:
            raise ValueError(
                f"{where} gives no rate of the state leaf `{leaf}`, need one of shape "
                f"{shapes[leaf]}. Return a rate for every leaf of `initial_state`."
            )
        if leaf not in shapes:
            raise ValueError(
                f"{where} gives a rate `{leaf}` that its state has not, need "
                f"{', '.join(shapes) or 'none'}. Leave it out, or add it to `initial_state`."
            )
        if shapes[leaf] != rates[leaf]:
            raise ValueError(
                f"{where} gives a rate of shape {rates[leaf]} for the state leaf `{leaf}`, "
                f"need {shapes[leaf]}. Return it in the shape of the state."
            )


def inputs_of(
    network: Network, t, state: PyTree, inputs: Signals, names: tuple[str, ...]
) -> dict[str, Signals]:
    """The inputs that the blocks called `names` get at one moment."""
    wanted = [f"{name}.{port}" for name in names for port in network.blocks[name].inputs]
    signals = _signals(network, t, state, inputs, wanted)
    return {name: _inputs_of(network, name, signals) for name in names}


def as_term(network: AbstractBlock, inputs: Signals | None = None) -> dfx.ODETerm:
    """The block as a diffrax term whose state is the state of the block.

    The block itself travels through `args`, so that it may be differentiated: call
    `diffrax.diffeqsolve(as_term(network), ..., args=network)`. With `args=None` the block
    given here is used.

    Args:
        network: The network, or any block.
        inputs: Values of free inputs by name.

    Returns:
        A term for `diffrax.diffeqsolve`.
    """

    return dfx.ODETerm(_Field(network, dict(inputs or {})))


class _Field(eqx.Module):
    """The rate of a block under inputs, as diffrax calls it."""

    block: AbstractBlock
    inputs: dict[str, Any]

    def __call__(self, t: Any, state: PyTree, args: Any) -> PyTree:
        system = self.block if args is None else args
        t = jnp.asarray(t)
        return system.vector_field(t, state, at_time(self.inputs, t))


def at_time(inputs: Mapping[str, Any], t: Float[Array, ""]) -> dict[str, Any]:
    """Values at `t` of inputs given as values or as functions of time."""
    values: dict[str, Any] = dict(inputs)
    return {name: x(t) if callable(x) else x for name, x in values.items()}


def _signals(
    network: Network, t, state, supplied: Signals, wanted: list[str]
) -> dict[str, Array]:
    """Inputs and outputs by full name, those `wanted` and what they depend on."""
    wires, ports = dict(network.wires), network.input_ports
    used = needed(network.blocks, wires, wanted)
    missing = [name for name in network.exposed if name in used and name not in supplied]
    missing = [name for name in missing if ports[name].default is None]
    if missing:
        raise ValueError(
            f"Network: the exposed input `{missing[0]}` got no value. Pass "
            f'inputs={{"{missing[0]}": ...}}.'
        )
    given: dict[str, Array] = {}
    for name, port in ports.items():
        if name in network.exposed and name in supplied:
            given[name] = supplied[name]
        elif name not in wires and port.default is not None:
            given[name] = jnp.full(port.shape, port.default, _dtype(state))
    torn = torn_wires(network.blocks, wires) if network.solve_loops else ()
    if not torn:
        return _propagated(network, wires, t, state, given, wanted)
    left = {name: source for name, source in wires.items() if name not in torn}
    sources = [wires[name] for name in torn]

    def around(values):
        signals = _propagated(network, left, t, state, {**given, **values}, sources)
        return {name: signals[wires[name]] for name in torn}

    guess = {name: jnp.zeros(ports[name].shape, _dtype(state)) for name in torn}
    solved = consistent(around, guess)
    return _propagated(network, left, t, state, {**given, **solved}, wanted)


def _dtype(state: PyTree):
    """That of the first floating number of a state."""
    kinds = [x.dtype for x in jax.tree.leaves(state) if eqx.is_inexact_array(x)]
    return kinds[0] if kinds else jnp.result_type(float)


def _propagated(
    network: Network, wires, t, state, given: Signals, wanted: list[str]
) -> dict[str, Array]:
    """Signals that follow from given ones along the wires, in an order that needs no loop; of
    outputs that nothing wanted depends on there is no trace."""
    signals, ports = dict(given), network.input_ports
    used = needed(network.blocks, wires, wanted)
    for name in evaluation_order(network.blocks, wires):
        if name not in used:
            continue
        if name in wires:
            signals[name] = signals[wires[name]]
        elif name not in ports:
            owner, port_name = name.split(".", 1)
            own = _inputs_of(network, owner, signals)
            block = network.blocks[owner]
            signals[name] = block.output(port_name, t, state[owner], own)
    return signals


def _inputs_of(network: Network, owner: str, signals: Signals) -> Signals:
    names = network.blocks[owner].inputs
    full = {name: f"{owner}.{name}" for name in names}
    return {name: signals[key] for name, key in full.items() if key in signals}
