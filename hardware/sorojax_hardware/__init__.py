"""Boards, clocks and the loop that runs a controller on them.

NumPy and the standard library only: importing this package starts no JAX and opens no
device.
"""

from sorojax_hardware.board_fault import BoardFault as BoardFault
from sorojax_hardware.cameras import (
    DrawnCamera as DrawnCamera,
    FolderCamera as FolderCamera,
    VideoCamera as VideoCamera,
)
from sorojax_hardware.clocks import (
    SimulatedClock as SimulatedClock,
    WallClock as WallClock,
)
from sorojax_hardware.desk import simulated as simulated
from sorojax_hardware.disturbed import DisturbedLink as DisturbedLink
from sorojax_hardware.latest import Latest as Latest
from sorojax_hardware.local_board import (
    LocalBoard as LocalBoard,
    simulated_board as simulated_board,
)
from sorojax_hardware.loop import (
    Deadlines as Deadlines,
    Overrun as Overrun,
    Tick as Tick,
    deadlines as deadlines,
    run_loop as run_loop,
    tick_recorder as tick_recorder,
)
from sorojax_hardware.memory import MemoryBoard as MemoryBoard
from sorojax_hardware.protocols import (
    Camera as Camera,
    Clock as Clock,
    Controller as Controller,
    Image as Image,
    ValveBoard as ValveBoard,
)
from sorojax_hardware.realsense import RealSenseCamera as RealSenseCamera
from sorojax_hardware.recorder import Recorder as Recorder, load_record as load_record
from sorojax_hardware.serving import ModelValves as ModelValves, serve as serve
from sorojax_hardware.tcp_board import TcpBoard as TcpBoard, connect as connect
