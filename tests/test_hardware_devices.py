"""What the bench finds, and what the network may do to a board beyond a cut."""

import contextlib
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sorojax_board import messages
from sorojax_board.__main__ import INSTALLER
from sorojax_board.bench import BenchValves
from sorojax_board.board import Board, settings
from sorojax_board.frames import NONCE_SIZE, Decoder, Frame, Kind, encode, session_keys
from sorojax_board.i2c import PLATFORM, I2CValves, dac_code
from sorojax_board.messages import Fault, State
from sorojax_board.session import WRITER, Session
from sorojax_hardware import (
    BoardFault,
    DisturbedLink,
    ModelValves,
    SimulatedClock,
    TcpBoard,
    VideoCamera,
    connect,
    serve,
)
from sorojax_hardware.cli import main
from tests.scripts import written_lines

kPa = 1e3
HARDWARE = Path(__file__).parents[1] / "hardware"
PATIENT = dict(low=-10 * kPa, high=60 * kPa, watchdog=5.0)  # a test machine may pause


class Webcam:
    """What OpenCV opens: numbers 1 and 3 are there, the second of them gives no image."""

    def __init__(self, source):
        self.source, self.asked = source, {}

    def isOpened(self):
        return self.source in (1, 3)

    def read(self):
        return self.source == 1, np.full((480, 640, 3), 7, np.uint8)

    def set(self, what, value):
        self.asked[what] = value

    def get(self, what):
        return 0.0  # a driver that does not tell its rate

    def release(self):
        self.source = None


@pytest.fixture
def webcams(monkeypatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "VideoCapture", Webcam)


def test_webcams_that_open_are_listed(webcams, capsys):
    assert main(["cameras"]) == 0
    assert capsys.readouterr().out == "camera 1: 640x480\ncamera 3: no image\n"
    assert main(["cameras", "--most", "1"]) == 0
    assert capsys.readouterr().out == "camera none opens\n"
    assert main(["devices", "--port", "1"]) == 0
    board, *cameras, depth = capsys.readouterr().out.strip().split("\n")
    assert board.startswith("board  none") and depth.startswith("depth  ")
    assert cameras == ["camera 1: 640x480", "camera 3: no image"]


def test_images_of_a_webcam_carry_the_clock(webcams):
    clock = SimulatedClock(5.0)
    camera = VideoCamera(1, clock, size=(640, 480))
    clock.sleep_until(7.25)
    image = camera.read()
    assert image is not None and image.time == 7.25 and image.colour[0, 0, 0] == 7
    assert VideoCamera(3, clock).read() is None
    camera.close()
    with pytest.raises(ConnectionError, match="camera 0 does not open"):
        VideoCamera(0)


@pytest.mark.stress(52)
def test_a_client_comes_back_after_a_cut_and_arms_again():
    valves = BenchValves(2, noise=0.0)
    with (
        serve(settings(2, **PATIENT), valves) as server,
        DisturbedLink(server.port) as link,
    ):
        board = connect(port=link.port, timeout=5.0)
        board.arm()
        board.write_pressure(np.full(2, 20 * kPa))
        link.cut()
        with pytest.raises((ConnectionError, OSError)):
            for _ in range(50):
                board.write_pressure(np.full(2, 20 * kPa))
        with connect(port=link.port, timeout=5.0) as again:
            with pytest.raises(BoardFault, match=r"fault: disconnected.*arm\(\)"):
                again.write_pressure(np.full(2, 20 * kPa))
            again.arm()
            again.write_pressure(np.full(2, 20 * kPa))
            assert again.report.state is State.ARMED and again.report.fault == Fault(0)


@pytest.mark.stress(52)
def test_half_a_frame_and_a_reset_while_the_board_answers():
    """A client that dies in the middle of a frame, and one that never reads what it asked."""
    with (
        serve(settings(2, **PATIENT), BenchValves(2, noise=0.0)) as server,
        TcpBoard(port=server.port, timeout=5.0) as board,
    ):
        board.arm()
        for kind in ("half", "deaf"):
            link = TcpBoard(port=server.port, timeout=5.0)._link
            link._sent += 1
            frame = Frame(Kind.PING, link._sent, time.monotonic_ns())
            ping = encode(frame, link._keys.to_board)
            link._socket.sendall(ping[:11] if kind == "half" else ping * 50)
            linger = struct.pack("ii", 1, 0)
            link._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            link._socket.close()
            board.write_pressure(np.full(2, 5 * kPa))
        start = time.monotonic()
        while len(server._clients) > 1:
            assert time.monotonic() - start < 5
            time.sleep(0.005)
        assert board.read_pressure().shape == (2,) and board.report.state is State.ARMED


def session_of(board, key=bytes(range(32))):
    """An armed writer: its session and a function that sends one frame as of a time."""
    nonce, count = bytes(NONCE_SIZE), iter(range(1, 10_000))
    session = Session(board, key, 0.0, nonce=nonce)
    keys = session_keys(key, nonce, nonce)

    def say(kind, payload=b"", now=0.0, stamp=None):
        stamp = now if stamp is None else stamp
        frame = Frame(kind, next(count), int((stamp + 100) * 1e9), payload)
        answers = Decoder().feed(session.receive(encode(frame, keys.to_board), now))
        return answers[-1] if answers else None

    say(Kind.HELLO, nonce + bytes([WRITER]))
    say(Kind.ARM, messages.pack_arm([(-10 * kPa, 60 * kPa)] * board.num_ports))
    return session, say


@pytest.mark.stress(52)
@pytest.mark.parametrize("jump", [30.0, -30.0])
def test_a_clock_that_jumps_never_keeps_old_set_points_alive(jump):
    """Forward, later frames count as the fastest so far; back, all are stale and the board
    vents."""
    valves = BenchValves(1, noise=0.0)
    board = Board(settings(1), valves)
    _, say = session_of(board)
    now, wanted = 0.0, messages.pack_set(1, [40 * kPa])
    for k in range(500):
        now = 0.002 * k
        stamp = now + (jump if now > 0.3 else 0.0)
        answer = say(Kind.SET, wanted, now, stamp)
        board.tick(now)
    if jump > 0:
        assert board.state is State.ARMED and answer.kind == Kind.STATE
        # what was sent before the jump and comes after it is old
        old = say(Kind.SET, wanted, now, now)
        assert messages.unpack_refused(old.payload)[1] is messages.Refusal.STALE
    else:
        assert board.fault is Fault.WATCHDOG and abs(valves.pressure[0]) < 0.2 * kPa


def test_a_heartbeat_comes_by_itself_and_stops_on_request():
    board = Board(settings(2), BenchValves(2, noise=0.0))
    session, say = session_of(board)
    say(Kind.SET, messages.pack_set(3, [20 * kPa, 0.0]), 0.0)
    assert session.tick(0.01) == b""
    assert say(Kind.WATCH, messages.pack_floats([0.02]), 0.02).kind == Kind.STATE
    beats = []
    for k in range(11, 200):
        now = 0.002 * k
        board.tick(now)
        beats += [(now, frame) for frame in Decoder().feed(session.tick(now))]
    times = np.array([now for now, _ in beats])
    assert np.allclose(np.diff(times), 0.02, atol=2.1e-3) and len(beats) == 18
    told = [messages.unpack_report(frame.payload) for _, frame in beats]
    assert {frame.kind for _, frame in beats} == {Kind.HEARTBEAT}
    assert told[3].state is State.ARMED and told[3].pressure[0] > 5 * kPa
    assert told[-1].fault is Fault.WATCHDOG and told[-1].setpoint[0] < 10 * kPa
    say(Kind.WATCH, messages.pack_floats([0.0]), 0.4)
    assert session.tick(1.0) == b""
    for wrong in (1e-4, 60.0, float("nan"), -1.0):
        refused = say(Kind.WATCH, messages.pack_floats([wrong]), 1.0)
        assert refused.kind == Kind.REFUSED


def test_a_client_watches_while_another_writes():
    with (
        serve(settings(2, **PATIENT), BenchValves(2, noise=0.0)) as server,
        TcpBoard(port=server.port, timeout=5.0) as board,
        TcpBoard(port=server.port, timeout=5.0, read_only=True) as watcher,
    ):
        board.arm()
        board.write_pressure(np.full(2, 30 * kPa))
        heart = watcher.watch(0.01)
        most = max(next(heart).pressure[0] for _ in range(30))
        assert most > 25 * kPa
        # answers are told from heartbeats that come between
        assert watcher.read_pressure()[0] > 25 * kPa
        heart.close()
        assert watcher.read_pressure().shape == (2,)
        with pytest.raises(BoardFault, match="refused WATCH: malformed"):
            next(watcher.watch(1e-5))


@pytest.mark.stress(52)
def test_a_line_that_has_become_slow_is_an_error_that_says_so():
    """Every frame 0.15 s later than the first: set-points are refused, and so are questions."""
    with (
        serve(settings(2, **PATIENT), BenchValves(2, noise=0.0)) as server,
        DisturbedLink(server.port) as link,
    ):
        board = TcpBoard(port=link.port, timeout=5.0)
        board.arm()
        link.delay = 0.15
        with pytest.raises(ConnectionError, match="5 frames in a row were 0.1 s late"):
            board.write_pressure(np.full(2, 20 * kPa))
        link.delay, start = 0.0, time.monotonic()
        while server.board.owner is not None:  # until the board has seen the old one go
            assert time.monotonic() - start < 5
            time.sleep(0.01)
        with connect(port=link.port, timeout=5.0) as again:
            again.arm()
            again.write_pressure(np.full(2, 20 * kPa))
            assert again.late == 0


class Converters:
    """A bus whose converters hold the last code, as they do when the processor stops."""

    def __init__(self, code):
        self.codes = {0x60: code, 0x61: code}

    def write(self, address, data):
        if address in self.codes:
            self.codes[address] = int.from_bytes(data, "big")

    def read(self, address, count):
        return bytes(2)


def test_a_board_that_was_killed_vents_when_it_starts_again():
    code = dac_code(70 * kPa)
    buses = {wire.bus: Converters(code) for wire in PLATFORM}
    board = Board(settings(12), I2CValves(buses))
    assert all(set(bus.codes.values()) == {code} for bus in buses.values())
    board.tick(0.0)
    zero = dac_code(0.0)
    assert all(set(bus.codes.values()) == {zero} for bus in buses.values())
    unit = (INSTALLER / "sorojax-board.service").read_text()
    assert "Restart=always" in unit and "--key" in unit


def test_a_server_that_is_killed_is_an_error_and_can_be_found_again():
    path = ":".join(filter(None, sys.path))
    command = [sys.executable, "-m", "sorojax_board", "--port"]

    @contextlib.contextmanager
    def process(port):
        child = subprocess.Popen(
            [*command, port], stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": path}
        )
        try:
            yield child, child.stdout.readline().rsplit(":", 1)[1].strip()  # type: ignore
        finally:
            child.kill()
            child.wait()

    with process("0") as (child, port):
        board = TcpBoard(port=int(port), timeout=5.0)
        board.arm()
        child.kill()
        child.wait()
        with pytest.raises((ConnectionError, OSError)):
            for _ in range(3):
                board.write_pressure(np.full(12, 1 * kPa))
    with process(port), connect(port=int(port), timeout=5.0) as again:
        assert again.report.state is State.VENTED


def test_a_chamber_that_leaks_sinks_below_its_set_point():
    valves = BenchValves(1, frequency=12.0, damping=0.9, leak=2.0, noise=0.0)
    valves.write([50 * kPa])
    for k in range(1000):
        valves.read(0.002 * k)
    # at rest the valve's rate makes good what leaks: w^2 (a - p) = 2 z w r, r = leak p
    w = 2 * np.pi * 12
    assert valves.pressure[0] == pytest.approx(50 * kPa / (1 + 2 * 0.9 * 2.0 / w), rel=2e-3)


def test_a_model_slower_than_time_runs_in_slow_motion():
    """One reading makes up for 10 ms at most, so that the board goes on judging."""
    steps = []

    def advance(state, setpoint, dt):
        steps.append(dt)
        return state + dt, np.zeros(1)

    valves = ModelValves(advance, 0.0, 1, period=0.005, noise=0.0)
    valves.read(10.0)
    valves.read(10.0081)
    assert len(steps) == 1 and valves.behind == 0.0
    valves.read(11.0051)
    assert len(steps) == 3 and valves.behind == pytest.approx(0.9901)
    assert valves.state == pytest.approx(0.015)


@pytest.mark.parametrize("name", ["cameras", "latest", "link", "local_board", "memory",
                                  "realsense", "serving", "tcp_board"])  # fmt: skip
def test_adapters_are_thin(name):
    assert written_lines(HARDWARE / "sorojax_hardware" / f"{name}.py") <= 90
