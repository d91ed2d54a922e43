"""Payloads: what the frames carry, in SI units."""

import struct
from collections.abc import Sequence
from enum import IntEnum, IntFlag
from typing import NamedTuple

MAX_PORTS = 32


class State(IntEnum):
    """What the board does."""

    VENTED = 0
    ARMED = 1
    FAULT = 2


class Fault(IntFlag):
    """Why the board vented; latched until it is armed again."""

    WATCHDOG = 1
    DISCONNECTED = 2
    OVER_PRESSURE = 4
    SENSOR = 8
    TRACKING = 16
    BACKEND = 32


class Flag(IntFlag):
    """What the board did with the last set-point of a port."""

    CLIPPED = 1
    SLEWING = 2


class Refusal(IntEnum):
    """Why a frame was not followed."""

    NOT_WRITER = 1
    NOT_ARMED = 2
    MALFORMED = 3
    NOT_FINITE = 4
    REPLAYED = 5
    STALE = 6
    TOO_FAST = 7


class Limits(NamedTuple):
    """Range of the set-point of one port, `low` to `high` [Pa, gauge], and its fastest change,
    `slew` [Pa/s]."""

    low: float
    high: float
    slew: float


class Welcome(NamedTuple):
    """What the board is: `watchdog`, its time-out [s], `ramp`, how long it takes to zero [s],
    and the `limits` of each port."""

    watchdog: float
    ramp: float
    limits: tuple[Limits, ...]


class Report(NamedTuple):
    """The state of the board.

    Attributes:
        sequence, time: Of the last SET that it followed; the time is its sender's [ns].
        state: What it does.
        fault: Why it vented.
        refused: Number of frames that it has not followed.
        pressure, setpoint: Measured and in force, one per port [Pa, gauge].
        flags: What it did with the last set-point of each port.
    """

    sequence: int
    time: int
    state: State
    fault: Fault
    refused: int
    pressure: tuple[float, ...]
    setpoint: tuple[float, ...]
    flags: tuple[Flag, ...]


class Malformed(ValueError):
    """A payload that is not what its kind says."""


def floats(payload: bytes, count: int) -> tuple[float, ...]:
    """`count` single-precision numbers and nothing else.

    Args:
        payload: Bytes of the frame.
        count: How many there must be.

    Returns:
        The numbers.
    """
    if len(payload) != 4 * count:
        raise Malformed(f"{len(payload)} bytes, need {4 * count}")
    return struct.unpack(f"<{count}f", payload)


def pack_floats(values: Sequence[float]) -> bytes:
    """Numbers one after the other in single precision, the lowest byte first.

    Args:
        values: The numbers.

    Returns:
        The bytes.
    """
    return struct.pack(f"<{len(values)}f", *values)


def pack_set(mask: int, pressures: Sequence[float]) -> bytes:
    """Set-points [Pa]; ports whose bit in `mask` is zero keep theirs.

    Args:
        mask: One bit per port.
        pressures: Of all ports [Pa].

    Returns:
        The payload.
    """
    return struct.pack("<I", mask) + pack_floats(pressures)


def unpack_set(payload: bytes, ports: int) -> tuple[int, tuple[float, ...]]:
    """The mask of the ports that are meant, and set-points [Pa] of all `ports`.

    Args:
        payload: Bytes of the frame.
        ports: Number of ports.

    Returns:
        Mask, and set-points [Pa].
    """
    if len(payload) < 4:
        raise Malformed(f"{len(payload)} bytes, need {4 + 4 * ports}")
    return struct.unpack_from("<I", payload)[0], floats(payload[4:], ports)


def pack_arm(ranges: Sequence[tuple[float, float]]) -> bytes:
    """Lowest and highest pressure of every port [Pa]; the board takes them where they are
    narrower than its own.

    Args:
        ranges: Lowest and highest of every port [Pa].

    Returns:
        The payload.
    """
    return pack_floats([bound for low_high in ranges for bound in low_high])


def unpack_arm(payload: bytes, ports: int) -> list[tuple[float, float]]:
    """Lowest and highest pressure of every port [Pa].

    Args:
        payload: Bytes of the frame.
        ports: Number of ports.

    Returns:
        Lowest and highest of every port [Pa].
    """
    values = floats(payload, 2 * ports)
    return list(zip(values[::2], values[1::2], strict=True))


def pack_welcome(welcome: Welcome) -> bytes:
    """Times of the board and limits of its ports, as it sends them.

    Args:
        welcome: What is sent.

    Returns:
        The payload.
    """
    flat = [number for limits in welcome.limits for number in limits]
    return pack_floats([welcome.watchdog, welcome.ramp, *flat])


def unpack_welcome(payload: bytes) -> Welcome:
    """The times and limits of a board; their number is that of its ports.

    Args:
        payload: Bytes of the frame.

    Returns:
        What was sent.
    """
    ports, rest = divmod(len(payload) - 8, 12)
    if rest or not 0 < ports <= MAX_PORTS:
        raise Malformed(f"{len(payload)} bytes, need 8 and 12 for each port")
    watchdog, ramp, *flat = floats(payload, 2 + 3 * ports)
    triples = zip(flat[::3], flat[1::3], flat[2::3], strict=True)
    return Welcome(watchdog, ramp, tuple(Limits(*triple) for triple in triples))


_REPORT = struct.Struct("<IQBHI")


def pack_report(report: Report) -> bytes:
    """State, pressures and flags of the board, as it sends them.

    Args:
        report: What is sent.

    Returns:
        The payload.
    """
    head = _REPORT.pack(
        report.sequence, report.time, report.state, report.fault, report.refused & 0xFFFFFFFF
    )
    numbers = pack_floats([*report.pressure, *report.setpoint])
    return head + numbers + bytes(int(flag) for flag in report.flags)


def unpack_report(payload: bytes) -> Report:
    """State, pressures and flags of a board with as many ports as the payload has.

    Args:
        payload: Bytes of the frame.

    Returns:
        What was sent.
    """
    ports, rest = divmod(len(payload) - _REPORT.size, 9)
    if rest or not 0 < ports <= MAX_PORTS:
        raise Malformed(f"{len(payload)} bytes, need {_REPORT.size} and 9 for each port")
    sequence, time, state, fault, refused = _REPORT.unpack_from(payload)
    numbers = floats(payload[_REPORT.size : _REPORT.size + 8 * ports], 2 * ports)
    flags = tuple(Flag(byte & 3) for byte in payload[_REPORT.size + 8 * ports :])
    try:
        return Report(
            sequence,
            time,
            State(state),
            Fault(fault),
            refused,
            numbers[:ports],
            numbers[ports:],
            flags,
        )
    except ValueError as wrong:
        raise Malformed(str(wrong)) from wrong


def pack_refused(sequence: int, why: Refusal) -> bytes:
    """Which frame the board did not follow, and why.

    Args:
        sequence: Number of the frame.
        why: The reason.

    Returns:
        The payload.
    """
    return struct.pack("<IB", sequence, why)


def unpack_refused(payload: bytes) -> tuple[int, Refusal]:
    """Which frame the board did not follow, and why.

    Args:
        payload: Bytes of the frame.

    Returns:
        Number of the frame, and the reason.
    """
    try:
        sequence, why = struct.unpack("<IB", payload)
        return sequence, Refusal(why)
    except (struct.error, ValueError) as wrong:
        raise Malformed(str(wrong)) from wrong
