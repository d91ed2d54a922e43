"""A bench without hardware: a simulated finger behind the program of a valve board, a drawn
camera, markers found in its pictures, a filter of the finger's shape, and a loop that moves
the tip.

On a real bench `TcpBoard`, a `VideoCamera` in `Latest` and `WallClock` take the places of
`simulated_board`, its clock and `DrawnCamera`; the rest stays.
"""

import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import vision
from sorojax.units import kPa, mm
from sorojax_hardware import DrawnCamera, run_loop, simulated_board

RATE, LIMITS = 100.0, (-20 * kPa, 60 * kPa)  # Hz, of the loop
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


def main(quick: bool = False, picture: str | None = None) -> dict[str, float]:
    # on the bench: six modes, 5 % stiffer than the model, valves with a lag
    model, finger = make_finger(3), make_finger(6, stiffer=1.05)
    robot = sj.robots.rod_stepper(finger, functools.partial(loads, 6), lag=0.03)
    board, valves = simulated_board(*robot, LIMITS)
    places = jax.jit(lambda q: sj.rod.forward_kinematics(finger, q, S)[:, :2, 2])
    random, kinds, width = np.random.default_rng(0), np.array([0, 1, 2, 0]), np.full(4, 9.0)

    def pixels():
        return np.asarray(places(valves.state.q)) * SCALE + CORNER

    def draw(_):
        canvas = vision.draw_discs(vision.background(640, 480), pixels(), width, kinds)
        return vision.photograph(canvas, vision.Disturbance(), random)

    camera = DrawnCamera(draw, board.clock, rate=30.0)
    first = vision.Discs(pixels(), width, kinds)
    seen = vision.MarkerStream(camera, first, COLOURS, lambda px: (px - CORNER) / SCALE)
    estimator = sj.systems.ShapeFilter(
        sj.systems.Markers(model, S), 1 / RATE, marker_noise=1e-4, force_noise=0.02
    )
    shape, log = sj.systems.start_filter(estimator), []

    @jax.jit
    def update(last, markers, pressure):
        new = sj.systems.update_filter(estimator, last, markers, forces=loads(3, pressure))
        return new, sj.rod.tip_pose(model, new.q)[1, 2]

    target = sj.systems.Sine(10 * mm, frequency=0.5, offset=15 * mm)
    low, high = LIMITS
    pid = sj.systems.PID(3e5, integral_gain=4e6, reference=target, low=low, high=high)  # Pa/m

    def measure(t, pressure):
        nonlocal shape
        shape, height = update(shape, seen.read(), pressure)
        log.append((t, target(t), height, places(valves.state.q)[-1, 1]))
        return height

    for _ in run_loop(
        board, board.clock, jax.jit(lambda *now: pid(*now)), pid.start(0.0, 0.0),
        period=1 / RATE, limits=LIMITS, duration=2.5 if quick else 6.0, measure=measure,
    ):  # fmt: skip
        pass
    t, wanted, told, true = np.array(log).T
    if picture is not None:
        plot(t, wanted, told, true, draw(0.0), Path(picture))
    settled = t > 1.0
    return {
        "estimate off the true tip [mm rms]": 1e3 * rms((told - true)[settled]),
        "tip off its target [mm rms]": 1e3 * rms((true - wanted)[settled]),
        "pictures used": float(seen.images),
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
    sj.enable_low_latency()
    names = [name for name in sys.argv[1:] if name != "--quick"]
    for name, value in main("--quick" in sys.argv, *names[:1]).items():
        print(f"{name:<36} {value:.4g}")
