"""Boards, clocks and the loop that runs a controller on them.

NumPy only: importing this package starts no JAX and opens no device.
"""

from sorojax_hardware.clocks import (
    SimulatedClock as SimulatedClock,
    WallClock as WallClock,
)
from sorojax_hardware.loop import (
    Deadlines as Deadlines,
    Tick as Tick,
    deadlines as deadlines,
    run_loop as run_loop,
)
from sorojax_hardware.memory import MemoryBoard as MemoryBoard
from sorojax_hardware.protocols import (
    Clock as Clock,
    Controller as Controller,
    ValveBoard as ValveBoard,
)
