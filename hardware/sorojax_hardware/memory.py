"""A valve board in memory, for tests and for trying a controller at the desk."""

import numpy as np

from sorojax_hardware.protocols import Clock


class MemoryBoard:
    """Each port follows its set-point as a first-order lag of the board's clock.

    Set-points beyond `limits` are cut to them, as a real regulator does; `clipped`
    tells at which ports the last one was.
    """

    def __init__(
        self,
        clock: Clock,
        num_ports: int = 1,
        *,
        time_constant: float = 0.03,
        limits: tuple[float, float] = (-100e3, 100e3),
    ):
        """
        Args:
            clock: Where the board reads the time.
            num_ports: Number of regulators.
            time_constant: Of the lag, one for all ports or one per port [s].
            limits: Lowest and highest gauge pressure [Pa].
        """
        lag = np.broadcast_to(np.asarray(time_constant, float), (num_ports,))
        if not np.all(lag > 0):
            raise ValueError(
                f"MemoryBoard: `time_constant` is {time_constant} s, need a positive "
                "number. A port that follows at once has a small one, 1e-6."
            )
        self._clock, self._lag, self._limits = clock, lag, limits
        self._setpoint = np.zeros(num_ports)
        self._pressure = np.zeros(num_ports)
        self._time = clock.now()
        self.clipped = np.zeros(num_ports, bool)

    @property
    def num_ports(self) -> int:
        return self._setpoint.size

    @property
    def setpoint(self) -> np.ndarray:
        """The set-points in force [Pa]."""
        return self._setpoint.copy()

    def read_pressure(self) -> np.ndarray:
        self._advance()
        return self._pressure.copy()

    def write_pressure(self, setpoint: np.ndarray) -> None:
        asked = np.asarray(setpoint, float)
        if asked.shape != self._setpoint.shape:
            raise ValueError(
                f"MemoryBoard: `setpoint` has shape {asked.shape}, need "
                f"{self._setpoint.shape}: one gauge pressure [Pa] per port."
            )
        if not np.all(np.isfinite(asked)):
            raise ValueError(
                f"MemoryBoard: `setpoint` is {asked} Pa, need finite numbers. The board "
                "keeps its last set-point; write zeros to vent."
            )
        self._advance()
        self._setpoint = np.clip(asked, *self._limits)
        self.clipped = self._setpoint != asked

    def vent(self) -> None:
        self.write_pressure(np.zeros_like(self._setpoint))

    def _advance(self) -> None:
        now = self._clock.now()
        left = np.exp(-(now - self._time) / self._lag)
        self._pressure = self._setpoint + (self._pressure - self._setpoint) * left
        self._time = now
