"""What a device must offer. A class fits by having these members; it inherits nothing."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class ValveBoard(Protocol):
    """Pressure regulators, one entry per port, gauge pressures [Pa].

    A set-point holds until the next one, or until the board's own watchdog. A board refuses
    NaN with a `ValueError` and keeps the set-point that it had.
    """

    @property
    def num_ports(self) -> int: ...

    def read_pressure(self) -> np.ndarray:
        """Measured gauge pressures [Pa]."""
        ...

    def write_pressure(self, setpoint: np.ndarray) -> None:
        """Ask for gauge pressures [Pa]."""
        ...

    def vent(self) -> None:
        """Let all ports go to ambient, whatever else was asked."""
        ...


@runtime_checkable
class Clock(Protocol):
    """Seconds from any fixed origin, never running backwards."""

    def now(self) -> float: ...

    def sleep_until(self, time: float) -> None:
        """Return at `time` [s], at once if it has passed."""
        ...


class Image(NamedTuple):
    """What a camera saw.

    Attributes:
        time: When, on the camera's clock [s].
        colour: Blue, green, red, 0 to 255, (height, width, 3).
        depth: Along the optical axis [m], zero where unknown, (height, width); or None.
    """

    time: float
    colour: np.ndarray
    depth: np.ndarray | None = None


@runtime_checkable
class Camera(Protocol):
    """A source of images, live or recorded."""

    def read(self) -> Image | None:
        """The latest image not read before, or `None` if there is none yet; never waits."""
        ...

    def close(self) -> None:
        """Let the device go."""
        ...


class Controller(Protocol):
    """A pure function; what it remembers travels through `state`."""

    def __call__(self, t: Any, measurement: Any, state: Any, /) -> tuple[Any, Any]:
        """`(command, state)` from time [s], measurement and state."""
        ...
