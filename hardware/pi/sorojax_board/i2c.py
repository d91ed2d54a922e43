"""The drivers of the control platform: MCP4725 converters out, ADS1015 converters in.

Up to six buses with one board of two regulators each. The bus is anything with `write`
and `read`, so the drivers are tested without one; `open_bus` gives the real one.

Reference: Microchip MCP4725 and Texas Instruments ADS1015 data sheets.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol


class Bus(Protocol):
    """An I2C bus."""

    def write(self, address: int, data: bytes) -> None: ...

    def read(self, address: int, count: int) -> bytes: ...


class Wiring(NamedTuple):
    """Where one port is connected.

    Attributes:
        bus: Number of the I2C bus.
        dac, adc: Addresses on it of the converters to the regulator and from the sensor.
        channel: Input of the latter that the sensor is on, 0 to 3.
        gain: Sensor volts per volt at the converter.
    """

    bus: int
    dac: int = 0x60
    adc: int = 0x48
    channel: int = 0
    gain: float = 10 / 3.3


#: Two ports a board, one board a bus, as on a Raspberry Pi 4.
PLATFORM = tuple(
    Wiring(bus, dac, adc)
    for bus in (1, 3, 4, 5, 6, 7)
    for dac, adc in ((0x60, 0x48), (0x61, 0x49))
)

_CONVERSION, _CONFIGURATION = 0x00, 0x01
_VOLTS_PER_STEP = 4.096 / 2048


def pressure_of_command(u: float) -> float:
    """Set-point [Pa] of a command in [0, 1].

    Args:
        u: Command, 0 to 1.

    Returns:
        Set-point [Pa].
    """
    return (200 * u - 100) * 1e3


def voltage_of_pressure(pressure: float) -> float:
    """Sensor voltage [V] of a pressure [Pa].

    Args:
        pressure: Pressure [Pa].

    Returns:
        Voltage [V].
    """
    return pressure / 20e3 + 5


def dac_code(pressure: float) -> int:
    """12-bit code of a set-point [Pa] in -100 .. 100 kPa, cut to the range.

    Args:
        pressure: Pressure [Pa].

    Returns:
        The code, 0 to 4095.
    """
    u = (pressure * 1e-3 + 100) / 200
    return min(max(round(u * 4095), 0), 4095)


def dac_pressure(code: int) -> float:
    """Set-point [Pa] of a 12-bit code.

    Args:
        code: 0 to 4095.

    Returns:
        Set-point [Pa].
    """
    return pressure_of_command(code / 4095)


def dac_bytes(pressure: float) -> bytes:
    """MCP4725 fast mode: four command bits, then the code.

    Args:
        pressure: Pressure [Pa].

    Returns:
        Two bytes.
    """
    return dac_code(pressure).to_bytes(2, "big")


def adc_request(channel: int) -> bytes:
    """ADS1015: start one conversion of `channel` to ground, 4.096 V, 3300 samples/s.

    Args:
        channel: 0 to 3.

    Returns:
        The bytes to write.
    """
    start, mux, gain, single, rate, no_alert = 1 << 15, 4 + channel, 1, 1, 6, 3
    config = start | mux << 12 | gain << 9 | single << 8 | rate << 5 | no_alert
    return bytes([_CONFIGURATION]) + config.to_bytes(2, "big")


def adc_pressure(data: bytes, gain: float) -> float:
    """Pressure [Pa] of a conversion register: p = 20 (V - 5) kPa.

    Args:
        data: Bytes of the register.
        gain: Of the divider in front of the converter.

    Returns:
        Pressure [Pa].
    """
    steps = int.from_bytes(data, "big", signed=True) >> 4
    return (steps * _VOLTS_PER_STEP * gain - 5) * 20e3


class I2CValves:
    """The regulators and sensors of the platform.

    A conversion is asked for after every read, so that none waits for a converter.
    """

    def __init__(self, buses: dict[int, Bus], wiring: Sequence[Wiring] = PLATFORM):
        missing = sorted({wire.bus for wire in wiring} - set(buses))
        if missing:
            raise ValueError(
                f"I2CValves: no bus {missing}, the wiring needs them. Open them, or leave "
                "their ports out of the wiring."
            )
        self._buses, self._wiring = buses, tuple(wiring)
        self._request()

    def write(self, pressures: Sequence[float]) -> None:
        for wire, pressure in zip(self._wiring, pressures, strict=True):
            self._buses[wire.bus].write(wire.dac, dac_bytes(pressure))

    def read(self, now: float) -> list[float]:
        found = []
        for wire in self._wiring:
            bus = self._buses[wire.bus]
            bus.write(wire.adc, bytes([_CONVERSION]))
            found.append(adc_pressure(bus.read(wire.adc, 2), wire.gain))
        self._request()
        return found

    def _request(self) -> None:
        for wire in self._wiring:
            self._buses[wire.bus].write(wire.adc, adc_request(wire.channel))


def open_bus(number: int) -> Bus:
    """The bus /dev/i2c-`number` through smbus2.

    Args:
        number: Of the bus.

    Returns:
        The bus.

    Raises:
        ImportError: If smbus2 is not installed.
    """
    try:
        import smbus2
    except ImportError as missing:
        raise ImportError("open_bus: need smbus2. pip install smbus2") from missing

    class SystemBus:
        def __init__(self):
            self._bus = smbus2.SMBus(number)

        def write(self, address: int, data: bytes) -> None:
            self._bus.i2c_rdwr(smbus2.i2c_msg.write(address, data))

        def read(self, address: int, count: int) -> bytes:
            message = smbus2.i2c_msg.read(address, count)
            self._bus.i2c_rdwr(message)
            return bytes(message)

    return SystemBus()
