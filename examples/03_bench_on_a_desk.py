"""A bench without hardware: a simulated finger behind the program of a valve board, a drawn
camera, markers found in its pictures, a filter of the finger's shape, and a loop that moves
the tip.

On a real bench `TcpBoard`, a `VideoCamera` in `Latest` and `WallClock` take the places of
`LocalBoard`, `DrawnCamera` and `SimulatedClock`; the rest stays.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import vision
from sorojax.math.steppers import GeneralisedAlpha, start
from sorojax.units import kPa, mm
from sorojax_board.board import settings
from sorojax_hardware import (
    DrawnCamera,
    LocalBoard,
    ModelValves,
    SimulatedClock,
    run_loop,
)

RATE, FRAMES = 100.0, 30.0  # Hz, of the loop and of the camera
S = np.array([0.25, 0.5, 0.75, 1.0])  # markers
SCALE, CORNER = 6000.0, np.array([60.0, 120.0])  # px per metre, px
COLOURS = (vision.RED, vision.GREEN, vision.BLUE, vision.RED)


def make_finger(modes: int, stiffer: float = 1.0):
    return sj.rod.rod(
        sj.SE2(), sj.rod.chebyshev(kappa_z=modes), sj.rod.circle(5 * mm), length=80 * mm,
        young_modulus=stiffer * 0.6e6, poisson_ratio=0.45, density=1080.0, nodes=8,
    )  # fmt: skip


def loads(modes: int, pressure):
    """Weight, damping, and a chamber that bends the finger by 0.2 N mm per kPa."""
    even = jnp.array([80 * mm / (1 - k * k) if k % 2 == 0 else 0.0 for k in range(modes)])
    chamber = sj.rod.Actuation(lambda q: 0.2e-6 * even[:, None], jnp.atleast_1d(pressure))
    return (sj.rod.Gravity([0.0, -9.81]), sj.rod.Damping(0.02), chamber)


def robot():
    """What is on the bench: six modes, 5 % stiffer than the model, a valve with a lag."""
    finger, step = make_finger(6, 1.05), GeneralisedAlpha()

    @jax.jit
    def advance(state, setpoint, dt):
        q, v, pressure = state
        pressure = pressure + (setpoint - pressure) * (1 - jnp.exp(-dt / 0.03))
        problem = sj.rod.second_order(finger, q, loads(6, pressure[0]))
        zero = jnp.zeros(())
        new = step.step(problem, zero, dt, start(problem, zero, q, v))
        return (new.q, new.v, pressure), pressure

    rest = (jnp.zeros(6), jnp.zeros(6), jnp.zeros(1))
    advance(rest, np.zeros(1), 0.005)[1].block_until_ready()
    places = jax.jit(lambda q: sj.rod.forward_kinematics(finger, q, S)[:, :2, 2])
    places(rest[0]).block_until_ready()
    return ModelValves(advance, rest, 1), places


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    model = make_finger(3)
    estimator = sj.systems.ShapeFilter(
        sj.systems.Markers(model, S), 1 / RATE, marker_noise=1e-4, force_noise=0.02
    )
    valves, places = robot()
    random, clock = np.random.default_rng(0), SimulatedClock()
    kinds, width = np.array([0, 1, 2, 0]), np.full(4, 9.0)

    def draw(_):
        pixels = np.asarray(places(valves.state[0])) * SCALE + CORNER
        canvas = vision.draw_discs(vision.background(640, 480), pixels, width, kinds)
        return vision.photograph(canvas, vision.Disturbance(), random)

    @jax.jit
    def update(last, seen, p):
        return sj.systems.update_filter(estimator, last, seen, forces=loads(3, p))

    tip = jax.jit(lambda q: sj.rod.tip_pose(model, q)[1, 2])
    nothing, log = np.full((4, 2), np.nan), []
    seen = np.asarray(places(valves.state[0])) * SCALE + CORNER
    tracks = vision.start_tracks(vision.Discs(seen, width, kinds))
    memory = [sj.systems.start_filter(estimator), tracks, 0]
    camera = DrawnCamera(draw, clock, rate=FRAMES)

    def measure(t, pressure):
        image, markers = camera.read(), nothing
        if image is not None:
            memory[2] += 1
            memory[1] = vision.follow(image.colour, memory[1], COLOURS)
            markers = (memory[1].discs.centre - CORNER) / SCALE
        memory[0] = update(memory[0], markers, float(pressure[0]))
        height = float(tip(memory[0].q))
        log.append((t, target(t), height, float(places(valves.state[0])[-1, 1])))
        return height

    def target(t):
        return 15 * mm + 10 * mm * np.sin(2 * np.pi * 0.5 * t)

    def controller(t, height, integral):
        error = target(t) - height
        integral = integral + error / RATE
        return 3e5 * error + 4e6 * integral, integral  # Pa

    board = LocalBoard(settings(1, low=-20 * kPa, high=60 * kPa), valves, clock)
    board.arm()
    for _ in run_loop(
        board, clock, controller, 0.0, duration=2.5 if quick else 6.0, period=1 / RATE,
        limits=(-20 * kPa, 60 * kPa), measure=measure,
    ):  # fmt: skip
        pass
    t, wanted, told, true = np.array(log).T
    if picture is not None:
        plot(t, wanted, told, true, draw(0.0), Path(picture))
    settled = t > 1.0
    return {
        "estimate off the true tip [mm rms]": 1e3 * rms((told - true)[settled]),
        "tip off its target [mm rms]": 1e3 * rms((true - wanted)[settled]),
        "pictures used": float(memory[2]),
    }


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def plot(t, wanted, told, true, frame, file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), width_ratios=(1, 1.5))
    left.imshow(frame[::-1, :, ::-1], origin="lower")
    left.set_title("what the camera sees")
    left.set_axis_off()
    for line, label in ((wanted, "target"), (true, "finger"), (told, "estimate")):
        right.plot(t, 1e3 * line, label=label, lw=2 if label == "target" else 1.2)
    right.set(xlabel="time [s]", ylabel="height of the tip [mm]")
    right.legend(frameon=False, loc="lower right")
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    for name, value in main(picture=sys.argv[1] if len(sys.argv) > 1 else None).items():
        print(f"{name:<36} {value:.4g}")
