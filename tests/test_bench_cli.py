"""The command of the bench, on a simulated board."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from sorojax_board.bench import BenchValves
from sorojax_board.board import settings
from sorojax_hardware import BoardFault, TcpBoard, load_record, serve
from sorojax_hardware.cli import main

kPa = 1e3


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    key = tmp_path_factory.mktemp("key") / "key"
    key.write_text(bytes(range(32)).hex())
    valves = BenchValves(2, noise=0.0)
    # a test machine may pause for longer than the usual watchdog
    limits = settings(2, low=-20 * kPa, high=60 * kPa, watchdog=5.0)
    with serve(limits, valves, key=bytes(range(32))) as server:
        yield ["--port", str(server.port), "--key", str(key)], valves


def test_status(board, capsys):
    options, _ = board
    assert main(["status", *options]) == 0
    text = capsys.readouterr().out
    assert "state vented, faults none" in text and text.count("60.0") == 2


def test_jog_brings_one_port_there_and_vents(board):
    options, valves = board
    seen = []
    read = valves.read
    valves.read = lambda now: seen.append(read(now)) or seen[-1]
    assert main(["jog", "1", "15", "--seconds", "0.6", *options]) == 0
    valves.read = read
    most = np.max(seen, axis=0)
    assert most[1] == pytest.approx(15 * kPa, abs=0.3 * kPa) and abs(most[0]) < 0.1 * kPa


def test_a_wave_is_recorded_and_replayed(board, tmp_path):
    options, _ = board
    first, second = tmp_path / "a.log", tmp_path / "b.log"
    assert main(["wave", "--seconds", "0.5", "--frequency", "2", "--out", str(first),
                 *options]) == 0  # fmt: skip
    columns, _ = load_record(first)
    assert columns["setpoint"].shape[1] == 2 and np.ptp(columns["setpoint"]) > 10 * kPa
    assert main(["replay", str(first), *options]) == 0
    assert main(["record", str(second), "--seconds", "0.1", *options]) == 0
    assert len(load_record(second)[0]["time"]) == 10


def test_devices_tells_of_boards_and_cameras(board, capsys):
    options, _ = board
    assert main(["devices", "--most", "0", *options]) == 0
    text = capsys.readouterr().out
    assert "2 ports, -20 to 60 kPa, vented" in text and "camera none opens" in text
    assert "depth  none" in text
    assert main(["devices", "--most", "0", "--port", "1"]) == 0
    assert "board  none: TcpBoard: no board at 127.0.0.1:1" in capsys.readouterr().out


MODEL = """
import numpy as np

def lag(period):
    part = 1 - np.exp(-period / 0.03)

    def advance(state, setpoint, dt):
        state = state + part * (setpoint - state)
        return state, state

    return advance, np.zeros(3), np.array([[-10e3, 50e3]] * 3)
"""


def test_a_model_of_ones_own_is_served(tmp_path):
    """The command in a process of its own, jogged from here."""
    (tmp_path / "desk_model.py").write_text(MODEL)
    path = ":".join([str(tmp_path), *filter(None, sys.path)])
    child = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "sorojax_hardware",
            "serve",
            "--model",
            "desk_model:lag",
            "--port",
            "0",
        ],
        stdout=subprocess.PIPE,
        text=True,
        env={"PYTHONPATH": path},
    )
    try:
        line = child.stdout.readline()  # type: ignore
        assert line.startswith("simulated desk_model:lag on 127.0.0.1:")
        with TcpBoard(port=int(line.rsplit(":", 1)[1]), timeout=5.0) as board:
            assert board.num_ports == 3 and board.limits[1].tolist() == [50 * kPa] * 3
            board.arm()
            start, most = time.monotonic(), 0.0
            while most < 19 * kPa and time.monotonic() - start < 10:
                try:
                    board.write_pressure(np.full(3, 20 * kPa))
                except BoardFault:  # the watchdog, on a busy machine
                    board.arm()
                most = board.report.pressure[1]
                time.sleep(0.005)
            assert most > 19 * kPa
    finally:
        child.send_signal(signal.SIGTERM)
    assert child.wait(10) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["serve", "--model", "no_such_module:f"], "no_such_module"),
        (["serve", "--model", "math:no_such"], "math has no function"),
    ],
)
def test_a_model_that_is_not_there_is_one_line(capsys, arguments, message):
    assert main(arguments) == 2
    text = capsys.readouterr().err
    assert message in text and text.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["jog", "7", "10"], "port 7, need 0 to 1"),
        (["replay", "nothing.log"], "nothing.log"),
        (["status", "--host", "127.0.0.1", "--port", "1"], "no board at"),
    ],
)
def test_wrong_input_is_one_line(board, capsys, arguments, message):
    options = board[0] if "--port" not in arguments else []
    assert main([*arguments, *options]) == 2
    text = capsys.readouterr().err
    assert message in text and text.count("\n") == 1


def test_images_for_calibration_from_a_film(tmp_path, capsys):
    cv2 = pytest.importorskip("cv2")
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(30):
        writer.write(np.full((48, 64, 3), 5 * k, np.uint8))
    writer.release()
    out = tmp_path / "images"
    assert main(["grab", str(film), str(out), "--every", "0.95"]) == 0
    assert "3 images" in capsys.readouterr().out and len(list(out.glob("*.png"))) == 3
