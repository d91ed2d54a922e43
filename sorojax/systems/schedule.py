"""Checks of a wiring and the order in which its ports are evaluated."""

import graphlib
from collections.abc import Callable, Iterable, Mapping

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from sorojax.systems.blocks.block import AbstractBlock

Blocks = Mapping[str, AbstractBlock]
Wires = Mapping[str, str]


def check_wires(blocks: Blocks, wires: Wires, exposed: tuple[str, ...]) -> None:
    """Raise a `ValueError` unless every input has one driver that fits it."""
    _check_names(blocks)
    for name, block in blocks.items():
        for ports in ("inputs", "outputs"):
            if not isinstance(getattr(block, ports), Mapping):
                raise TypeError(
                    f"Network: `{ports}` of the block `{name}` ({type(block).__name__}) is a "
                    f"{type(getattr(block, ports)).__name__}, need a dict of ports by name. "
                    "Write it as a property: @property above its def."
                )
    inputs = {f"{b}.{n}": p for b, block in blocks.items() for n, p in block.inputs.items()}
    made = {f"{b}.{n}": p for b, block in blocks.items() for n, p in block.outputs.items()}
    for target, source in wires.items():
        _need_known("input", target, inputs, f"{source} drives it")
        _need_known("output", source, made, f"it should drive {target}")
        _need_fit(target, inputs[target], source, made[source])
    for name in exposed:
        _need_known("input", name, inputs, "it is listed as exposed")
        if name in wires:
            raise ValueError(
                f"Network: `{name}` is exposed and also driven by `{wires[name]}`; an input "
                "has one driver. Remove the wire or the exposure."
            )
    for name, port in inputs.items():
        if port.default is None and name not in wires and name not in exposed:
            fits = [n for n, out in made.items() if _fits(port, out)]
            raise ValueError(
                f"Network: `{name}` [{port.unit}] is not connected and has no default. "
                f"Wire it to an output that fits ({', '.join(fits) or 'none here'}) "
                f'or expose it: exposed=("{name}",).'
            )


def evaluation_order(blocks: Blocks, wires: Wires) -> list[str]:
    """Full names of wired inputs and outputs, each after what it depends on.

    Raises:
        ValueError: If outputs depend on themselves at the same instant.
    """
    order, loop = _sorted(blocks, wires)
    if loop:
        path = [name for name in loop if name not in wires]
        raise ValueError(
            f"Network: algebraic loop {' -> '.join([*path, path[0]])}: these outputs need each "
            "other at the same instant. Put a state (a filter, a reservoir) between them, or "
            "have it solved at every instant: Network(..., solve_loops=True)."
        )
    return order


def _sorted(blocks: Blocks, wires: Wires) -> tuple[list[str], list[str]]:
    """Ports, each after what it needs, or those around an algebraic loop, in this order."""
    try:
        return list(graphlib.TopologicalSorter(_dependencies(blocks, wires)).static_order()), []
    except graphlib.CycleError as error:
        return [], error.args[1][1:]


def needed(blocks: Blocks, wires: Wires, wanted: Iterable[str]) -> set[str]:
    """Ports that those `wanted` depend on at the same instant, and these."""
    return _reached(_dependencies(blocks, wires), wanted)


def _reached(depends: Mapping[str, list[str]], wanted: Iterable[str]) -> set[str]:
    found: set[str] = set()
    left = list(wanted)
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left += depends.get(name, [])
    return found


def reachable_inputs(
    blocks: Blocks, wires: Wires, exposed: tuple[str, ...]
) -> dict[str, frozenset[str]]:
    """For every output, the exposed inputs that it needs at the same instant."""
    depends = _dependencies(blocks, wires)
    return {name: frozenset(exposed) & _reached(depends, [name]) for name in depends}


def _dependencies(blocks: Blocks, wires: Wires) -> dict[str, list[str]]:
    depends: dict[str, list[str]] = {}
    for owner, block in blocks.items():
        for name in block.inputs:
            full = f"{owner}.{name}"
            depends[full] = [wires[full]] if full in wires else []
        for name, port in block.outputs.items():
            depends[f"{owner}.{name}"] = [f"{owner}.{need}" for need in sorted(port.needs)]
    return depends


def _check_names(blocks: Blocks) -> None:
    bad = [name for name in blocks if "." in name or not name]
    if bad:
        raise ValueError(
            f"Network: the block name {bad[0]!r} contains a dot or nothing; a port is "
            "written block.port. Rename the block."
        )


def _need_known(kind: str, name: str, ports: Mapping, why: str) -> None:
    if name not in ports:
        raise ValueError(
            f"Network: there is no {kind} `{name}` ({why}); the {kind}s are "
            f"{', '.join(ports) or 'none'}. Wires are written {{input: output}}."
        )


def _need_fit(target: str, port, source: str, made) -> None:
    if not _fits(port, made):
        many = (
            f" For {made.shape[0]} signals, `systems.stack` {made.shape[0]} such blocks."
            if port.shape == () and len(made.shape) == 1 and made.shape[0] > 1
            else ""
        )
        raise ValueError(
            f"Network: `{source}` [{made.unit}, shape {made.shape}] cannot drive `{target}` "
            f"[{port.unit}, shape {port.shape}]. Connect ports of one unit and one shape.{many}"
        )


def _fits(port, made) -> bool:
    any_unit = port.unit is None or made.unit is None
    return (any_unit or port.unit == made.unit) and port.shape == made.shape


# Algebraic loops: torn wires, and the root find that makes them consistent


Signals = dict[str, Array]


def torn_wires(blocks: Blocks, wires: Wires) -> tuple[str, ...]:
    """Wired inputs to cut, one per loop, so that the rest can be evaluated in order."""
    left = dict(wires)
    torn: list[str] = []
    while loop := _sorted(blocks, left)[1]:
        name = min(entry for entry in loop if entry in left)
        del left[name]
        torn.append(name)
    return tuple(torn)


def consistent(propagate: Callable[[Signals], Signals], guess: Signals) -> Signals:
    """Values of torn inputs that equal what `propagate` makes of them.

    One step solves loops that are linear; derivatives follow from the implicit function
    theorem. Where no root is found the values are NaN, which ends a simulation.
    """

    def residual(values, _):
        return jax.tree.map(lambda a, b: a - b, propagate(values), values)

    solver = optx.Newton(rtol=1e-12, atol=1e-12)
    found = optx.root_find(residual, solver, guess, max_steps=50, throw=False)
    good = found.result == optx.RESULTS.successful
    return jax.tree.map(lambda x: jnp.where(good, x, jnp.full_like(x, jnp.nan)), found.value)
