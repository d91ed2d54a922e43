"""What the board enforces, given by a program or a file, and what it may be.

A limit that is not finite, of the wrong sign or beyond any regulator is no protection, so
every number has a range and is refused by name before a valve moves.
"""

import json
import numbers
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sorojax_board.i2c import PLATFORM, Wiring
from sorojax_board.messages import MAX_PORTS, Limits


class Settings(NamedTuple):
    """What the board enforces; pressures are gauge.

    Attributes:
        limits: Of each port.
        watchdog: Time without a set-point after which it vents [s].
        ramp: Time in which it then takes set-points to zero [s].
        rate: Set-points that it follows in a second [1/s].
        over_pressure: How far a measurement may lie beyond the limits of its port [Pa].
        tracking: How far it may lie from the set-point [Pa] for longer than `patience`.
        patience: See `tracking` [s].
        plausible: Lowest and highest pressure that a working sensor can read [Pa].
    """

    limits: tuple[Limits, ...]
    watchdog: float = 0.1
    ramp: float = 0.45
    rate: float = 1000.0
    over_pressure: float = 10e3
    tracking: float = 30e3
    patience: float = 1.0
    plausible: tuple[float, float] = (-120e3, 140e3)


def settings(ports: int = 12, low=-100e3, high=100e3, slew=2e6, **more) -> Settings:
    """Equal limits for every port.

    Args:
        ports: Number of ports.
        low: Lowest set-point [Pa].
        high: Highest set-point [Pa].
        slew: Fastest change of a set-point [Pa/s].
        **more: Other numbers of `Settings`.

    Returns:
        The settings.
    """
    return Settings(limits=(Limits(low, high, slew),) * ports, **more)


class Range(NamedTuple):
    """Bounds of a number, `low` and `high`, both allowed, and its `unit`."""

    low: float
    high: float
    unit: str


_VACUUM = -101_325.0  # Pa, gauge
_PORT = {
    "low": Range(_VACUUM, 0.0, "Pa"),
    "high": Range(0.0, 1e6, "Pa"),
    "slew": Range(1.0, 1e9, "Pa/s"),
}
_BOARD = {
    "watchdog": Range(0.02, 60.0, "s"),
    "ramp": Range(0.01, 5.0, "s"),
    "rate": Range(10.0, 10e3, "set-points/s"),
    "over_pressure": Range(100.0, 100e3, "Pa"),
    "tracking": Range(100.0, 200e3, "Pa"),
    "patience": Range(0.01, 10.0, "s"),
}
_SENSOR = Range(2 * _VACUUM, 2e6, "Pa")
_SHORT_WATCHDOG = Range(0.02, 0.5, "s")  # of a board that drives a robot
_WIRE = {
    "bus": Range(0, 255, ""),
    "dac": Range(0x08, 0x77, ""),
    "adc": Range(0x08, 0x77, ""),
    "channel": Range(0, 3, ""),
    "gain": Range(0.01, 1000.0, ""),
}


def check(where: str, settings: Settings) -> None:
    """Refuse limits that would not protect.

    Args:
        where: Who asks, for the message.
        settings: What is to be checked.

    Raises:
        ValueError: If a number is not in its range; it names the number.
    """
    ports = settings.limits
    if not 1 <= len(ports) <= MAX_PORTS:
        raise ValueError(
            f"{where}: `ports` has {len(ports)} entries, need 1 to {MAX_PORTS}. Give one for "
            "every regulator."
        )
    for number, port in enumerate(ports):
        for key, bounds in _PORT.items():
            _need(where, f"ports[{number}].{key}", getattr(port, key), bounds)
    for key, bounds in _BOARD.items():
        _need(where, key, getattr(settings, key), bounds)
    _check_plausible(where, settings)


def _check_plausible(where: str, settings: Settings) -> None:
    given = settings.plausible
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise ValueError(
            f"{where}: `plausible` is {_shown(given)}, need two pressures [Pa], lowest and "
            "highest. Write [-120000, 140000]."
        )
    for number, value in enumerate(given):
        _need(where, f"plausible[{number}]", value, _SENSOR)
    low = min(port.low for port in settings.limits)
    high = max(port.high for port in settings.limits)
    if not (given[0] <= low and high <= given[1]):
        raise ValueError(
            f"{where}: `plausible` is {given[0]:g} to {given[1]:g} Pa, need it to hold the "
            f"limits of every port, {low:g} to {high:g} Pa. Set it to what sensors can read."
        )


def _need(where: str, key: str, value: Any, bounds: Range) -> None:
    """Raise unless `value` is a number within `bounds`; NaN lies within none."""
    if not (_is_number(value) and bounds.low <= value <= bounds.high):
        unit = f" {bounds.unit}" if bounds.unit else ""
        raise ValueError(
            f"{where}: `{key}` is {_shown(value)}, need {bounds.low:g} to {bounds.high:g}"
            f"{unit}. Set `{key}` to a number in that range."
        )


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def read_config(path: Path | None) -> tuple[Settings, tuple[Wiring, ...]]:
    """Settings and wiring: `{"ports": [{"low": -10e3, "high": 60e3, "slew": 2e6}, ...],
    "watchdog": 0.1, "wiring": [{"bus": 1, "dac": 96, "adc": 72}, ...]}`.

    The other numbers of `Settings` may be given as well.

    Args:
        path: File name; None for the limits and the wiring of the control platform.

    Returns:
        Settings, and the wiring of each port.

    Raises:
        ValueError: If the file is no such JSON, or a number is missing or not in its range;
            it names the number.
    """
    if path is None:
        return settings(len(PLATFORM)), PLATFORM
    where = str(path)
    try:
        told = json.loads(path.read_text())
    except (ValueError, RecursionError) as wrong:
        raise ValueError(
            f"{where}: not JSON ({wrong}), need JSON. Correct that place."
        ) from wrong
    _keys(where, "the file", told, {"ports"}, {*_BOARD, "plausible", "wiring"})
    limits = tuple(
        Limits(**{"slew": 2e6} | port)
        for port in _entries(where, "ports", told.pop("ports"), {"low", "high"}, {"slew"})
    )
    given = told.pop("wiring", None)
    wiring = PLATFORM if given is None else tuple(_wires(where, given))
    made = Settings(limits, **told)
    check(where, made)
    _need(where, "watchdog", made.watchdog, _SHORT_WATCHDOG)
    if len(wiring) < len(limits):
        raise ValueError(
            f"{where}: `wiring` has {len(wiring)} entries, need one for each of the "
            f"{len(limits)} ports. Add the missing ones."
        )
    return made, wiring[: len(limits)]


def _wires(where: str, given: Any) -> Iterator[Wiring]:
    seen: dict[tuple, int] = {}
    optional = {"dac", "adc", "channel", "gain"}
    for number, wire in enumerate(_entries(where, "wiring", given, {"bus"}, optional)):
        made = Wiring(**wire)
        for key, bounds in _WIRE.items():
            value = getattr(made, key)
            _need(where, f"wiring[{number}].{key}", value, bounds)
            if key != "gain" and not isinstance(value, int):
                raise ValueError(
                    f"{where}: `wiring[{number}].{key}` is {_shown(value)}, need a whole "
                    "number. Write the address in decimal."
                )
        for place in (("dac", made.bus, made.dac), ("adc", made.bus, made.adc, made.channel)):
            first = seen.setdefault(place, number)
            if first != number:
                raise ValueError(
                    f"{where}: `wiring[{number}].{place[0]}` is that of `wiring[{first}]`, "
                    "need a converter of its own for every port. Correct the address."
                )
        yield made


def _entries(where, key, given: Any, needed: set[str], more: set[str]) -> Iterable[dict]:
    if not isinstance(given, list):
        raise ValueError(f"{where}: `{key}` is {_shown(given)}, need a list. Write [{{...}}].")
    for number, entry in enumerate(given):
        _keys(where, f"`{key}[{number}]`", entry, needed, more)
    return given


def _keys(where: str, name: str, given: Any, needed: set[str], more: set[str]) -> None:
    if not isinstance(given, dict):
        raise ValueError(
            f"{where}: {name} is {_shown(given)}, need an object. Write {{...}} with "
            f"{', '.join(sorted(needed))}."
        )
    if missing := needed - given.keys():
        raise ValueError(
            f"{where}: {name} has no `{min(missing)}`, need {', '.join(sorted(needed))}. "
            "Add it."
        )
    if unknown := given.keys() - needed - more:
        raise ValueError(
            f"{where}: {name} has the unknown key `{min(unknown)}`, need some of "
            f"{', '.join(sorted(needed | more))}. Correct or remove it."
        )
