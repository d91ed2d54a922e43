"""The command `sorojax-bench`: find devices, look at a board, jog a port, record, replay, run
a controller, and put a simulated robot behind a board."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sorojax_hardware.board_fault import BoardFault
from sorojax_hardware.cameras import VideoCamera
from sorojax_hardware.clocks import WallClock
from sorojax_hardware.desk import add_devices, add_serve, webcams
from sorojax_hardware.loop import deadlines, run_loop, tick_recorder
from sorojax_hardware.recorder import load_record
from sorojax_hardware.tcp_board import TcpBoard

_PERIOD = 0.01  # s


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; a wrong input ends with one line and 2."""
    asked = _parser().parse_args(argv)
    try:
        return asked.run(asked)
    except (ValueError, OSError, ImportError, BoardFault) as wrong:
        print(f"sorojax-bench: {' '.join(str(wrong).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("sorojax-bench: interrupted; the board vents", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sorojax-bench", description=__doc__)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(name: str, run, text: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=text, description=text)
        made.set_defaults(run=run)
        return made

    def board(name: str, run, text: str) -> argparse.ArgumentParser:
        made = command(name, run, text)
        made.add_argument("--host", default="127.0.0.1", help="address of the board")
        made.add_argument("--port", type=int, default=5053)
        made.add_argument("--key", type=Path, help="file with the key of the board")
        return made

    board("status", _status, "ports, limits, pressures and faults of a board")
    jog = board("jog", _jog, "bring one port to a pressure, hold it, vent")
    jog.add_argument("which", type=int, metavar="PORT", help="number of the port, from 0")
    jog.add_argument("pressure", type=float, help="gauge pressure [kPa]")
    jog.add_argument("--seconds", type=float, default=2.0)
    record = board("record", _record, "watch a board and write its pressures to a file")
    record.add_argument("file", type=Path)
    record.add_argument("--seconds", type=float, default=10.0)
    replay = board("replay", _replay, "send the set-points of a record again")
    replay.add_argument("file", type=Path)
    wave = board("wave", _wave, "follow a sine on all ports with a PI controller")
    wave.add_argument("--amplitude", type=float, default=10.0, help="[kPa]")
    wave.add_argument("--frequency", type=float, default=0.5, help="[Hz]")
    wave.add_argument("--seconds", type=float, default=10.0)
    wave.add_argument("--out", type=Path, help="record of the run")
    add_serve(command)
    add_devices(board)
    cameras = command("cameras", _cameras, "webcams that open")
    cameras.add_argument("--most", type=int, default=4, help="how many numbers to try")
    grab = command("grab", _grab, "save images of a webcam or video, for calibration")
    grab.add_argument("source", help="number of the camera, or a video file")
    grab.add_argument("folder", type=Path)
    grab.add_argument("--count", type=int, default=15)
    grab.add_argument("--every", type=float, default=1.0, help="seconds between images")
    return parser


def _connected(asked, **options) -> TcpBoard:
    key = bytes.fromhex(asked.key.read_text().strip()) if asked.key else b""
    return TcpBoard(asked.host, asked.port, key=key, timeout=1.0, **options)


def _status(asked) -> int:
    with _connected(asked, read_only=True) as board:
        report, (low, high) = board.report, board.limits
    faults = "none" if not report.fault else str(report.fault.name).lower()
    print(f"state {report.state.name.lower()}, faults {faults}, refused {report.refused}")
    print(f"{'port':>4} {'pressure':>10} {'set-point':>10} {'low':>8} {'high':>8}  [kPa]")
    rows = zip(report.pressure, report.setpoint, low, high, strict=True)
    for port, numbers in enumerate(rows):
        pressure, setpoint, least, most = (number * 1e-3 for number in numbers)
        print(f"{port:>4} {pressure:>10.2f} {setpoint:>10.2f} {least:>8.1f} {most:>8.1f}")
    return 0


def _jog(asked) -> int:
    with _connected(asked) as board:
        if not 0 <= asked.which < board.num_ports:
            raise ValueError(f"port {asked.which}, need 0 to {board.num_ports - 1}")
        goal = np.zeros(board.num_ports)
        goal[asked.which] = asked.pressure * 1e3
        board.arm((np.minimum(goal, 0.0), np.maximum(goal, 0.0)))
        for tick in _run(board, lambda t, p, s: (goal, s), None, asked.seconds, slew=50e3):
            _show(tick.time, f"{tick.pressure[asked.which] * 1e-3:8.2f} kPa")
    print()
    return 0


def _record(asked) -> int:
    with (
        _connected(asked, read_only=True) as board,
        tick_recorder(asked.file, board.num_ports) as log,
    ):
        clock, tick = WallClock(), 0
        start = clock.now()
        while tick * _PERIOD < asked.seconds:
            now = clock.now() - start
            pressure = board.read_pressure()
            log.write(now, now - tick * _PERIOD, pressure, board.report.setpoint)
            _show(now, f"{tick + 1} samples")
            tick += 1
            clock.sleep_until(start + tick * _PERIOD)
    print()
    return 0


def _replay(asked) -> int:
    columns, _ = load_record(asked.file)
    times, wanted = columns["time"], columns["setpoint"]
    if not len(times):
        raise ValueError(f"{asked.file} has no samples")

    def held(t, pressure, state):
        return wanted[max(int(np.searchsorted(times, t, side="right")) - 1, 0)], state

    with _connected(asked) as board:
        if wanted.shape[1] != board.num_ports:
            raise ValueError(
                f"{asked.file} has {wanted.shape[1]} ports, the board {board.num_ports}"
            )
        board.arm((wanted.min(axis=0), wanted.max(axis=0)))
        for tick in _run(board, held, None, float(times[-1]) + _PERIOD):
            _show(tick.time, "")
    print()
    return 0


def _wave(asked) -> int:
    amplitude, rate = asked.amplitude * 1e3, 2 * np.pi * asked.frequency

    def controller(t, pressure, integral):
        goal = amplitude * np.sin(rate * t)
        integral = integral + (goal - pressure) * _PERIOD
        return goal + 0.3 * (goal - pressure) + 4.0 * integral, integral

    with _connected(asked) as board:
        most = 1.5 * abs(amplitude)
        board.arm((-most, most))
        log = tick_recorder(asked.out, board.num_ports) if asked.out else None
        ticks = []
        try:
            start = np.zeros(board.num_ports)
            for tick in _run(board, controller, start, asked.seconds, record=log):
                ticks.append(tick)
                _show(tick.time, f"{tick.pressure[0] * 1e-3:8.2f} kPa")
        finally:
            if log is not None:
                log.close()
    late = deadlines(ticks, _PERIOD)
    print(
        f"\n{late.num_ticks} ticks, {late.num_skipped} left out, {late.num_behind} more than "
        f"a period late; late by a median of "
        f"{late.median_late * 1e3:.2f} ms, p99 {late.p99_late * 1e3:.2f} ms"
    )
    return 0


def _run(board: TcpBoard, controller, state, seconds: float, slew=np.inf, record=None):
    return run_loop(
        board,
        WallClock(),
        controller,
        state,
        duration=seconds,
        period=_PERIOD,
        limits=board.limits,
        slew=slew,
        record=record,
    )


def _show(t: float, text: str) -> None:
    if sys.stdout.isatty():
        print(f"\r{t:6.2f} s  {text}", end="", flush=True)


def _cameras(asked) -> int:
    print("\n".join(webcams(asked.most)))
    return 0


def _grab(asked) -> int:
    import cv2

    source = int(asked.source) if asked.source.isdigit() else asked.source
    camera, last, count = VideoCamera(source), -np.inf, 0
    asked.folder.mkdir(parents=True, exist_ok=True)
    try:
        while count < asked.count:
            image = camera.read()
            if image is None:
                break
            now = time.monotonic() if isinstance(source, int) else image.time
            if now - last < asked.every:
                continue
            last = now
            cv2.imwrite(str(asked.folder / f"{count:03d}.png"), image.colour)
            count += 1
    finally:
        camera.close()
    print(f"{count} images in {asked.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
