"""What a device must offer. A class fits by having these members; it inherits nothing."""

from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class ValveBoard(Protocol):
    """Pressure regulators, one entry per port, gauge pressures [Pa].

    A set-point holds until the next one; zero vents. A board refuses NaN with a
    `ValueError` and keeps the set-point that it had.
    """

    @property
    def num_ports(self) -> int: ...

    def read_pressure(self) -> np.ndarray:
        """Measured gauge pressures [Pa]."""
        ...

    def write_pressure(self, setpoint: np.ndarray) -> None:
        """Ask for gauge pressures [Pa]."""
        ...


@runtime_checkable
class Clock(Protocol):
    """Seconds from any fixed origin, never running backwards."""

    def now(self) -> float: ...

    def sleep_until(self, time: float) -> None:
        """Return at `time` [s], at once if it has passed."""
        ...


class Controller(Protocol):
    """A pure function; what it remembers travels through `state`."""

    def __call__(self, t: Any, measurement: Any, state: Any, /) -> tuple[Any, Any]:
        """`(command, state)` from time [s], measurement and state."""
        ...
