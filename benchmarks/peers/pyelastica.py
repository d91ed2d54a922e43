"""A finger released at rest, a rod in free flight, and an arm whose base is turned, in
PyElastica: `python -I pyelastica.py FOLDER`.

Its own damping is left out; the step is a share of what an element can bear.
"""

import json
import os
import sys
import time
from pathlib import Path

import elastica as ea
import numpy as np

clock = time.process_time if os.environ.get("SOROJAX_BENCH_CPU") == "1" else time.perf_counter
LENGTH, RADIUS, MODULUS, RATIO, DENSITY = 0.08, 0.006, 1e6, 0.3, 2000.0
GRAVITY = np.array([0.0, 0.0, -9.81])
WARM_UP = 10  # steps that compile


class Scene(ea.BaseSystemCollection, ea.Constraints, ea.Forcing):
    pass


def finger(elements):
    """The clamped rod along x with its weight."""
    scene = Scene()
    rod = ea.CosseratRod.straight_rod(
        elements,
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        LENGTH,
        RADIUS,
        DENSITY,
        youngs_modulus=MODULUS,
        shear_modulus=MODULUS / 2 / (1 + RATIO),
    )
    scene.append(rod)
    scene.constrain(rod).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    scene.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=GRAVITY)
    scene.finalize()
    return scene, rod


def advance(scene, rod, step, count, every):
    """Tips after every so many steps."""
    stepper, now, tips = ea.PositionVerlet(), np.float64(0.0), []
    for k in range(count):
        now = stepper.step(scene, now, np.float64(step))
        if (k + 1) % every == 0:
            tips.append(rod.position_collection[:, -1].copy())
    return np.array(tips)


def simulation(request, arrays):
    """Tips every `save_dt`; steps of at most `share` of the time that a wave of strain
    needs for an element."""
    elements, saves = request["elements"], round(request["duration"] / request["save_dt"])
    largest = request["share"] * LENGTH / elements / np.sqrt(MODULUS / DENSITY)
    every = int(np.ceil(request["save_dt"] / largest))
    step = request["save_dt"] / every
    start = clock()
    advance(*finger(elements), step, WARM_UP, WARM_UP)
    first, runs = clock() - start, []
    for _ in range(request["repeats"]):
        scene, rod = finger(elements)
        start = clock()
        tips = advance(scene, rod, step, saves * every, every)
        runs.append(clock() - start)
    return {"compile_s": first, "runs": runs, "step": step}, {"tips": tips}


# Rods by their stiffness and inertia per length, which PyElastica has by radius and density


class Pulse(ea.NoForces):
    """A dead moment and force on the first element and node, times a function of time."""

    def __init__(self, wrench, times, shares):
        super().__init__()
        self.moment, self.force = np.array(wrench[:3]), np.array(wrench[3:])
        self.times, self.shares = times, shares

    def apply_forces(self, system, time=0.0):
        share = np.interp(time, self.times, self.shares)
        system.external_forces[:, 0] += share * self.force

    def apply_torques(self, system, time=0.0):
        share = np.interp(time, self.times, self.shares)
        system.external_torques[:, 0] += (
            share * system.director_collection[:, :, 0] @ self.moment
        )


def bar(elements, numbers, base, axes):
    """A straight rod along the first of `axes`: length, stiffness in stretch, shear and
    bending, mass and rotary inertia per length across the axis, twice that about it."""
    length, axial, shear, bending, mass, inertia = numbers
    h = length / elements
    rod = ea.CosseratRod.straight_rod(
        elements, base, axes[:, 0].copy(), axes[:, 1].copy(), length, 0.1, 1.0,
        youngs_modulus=1.0, shear_modulus=1.0,
    )  # fmt: skip
    rod.mass[:] = mass * h
    rod.mass[[0, -1]] /= 2
    for k, (rotary, stiff) in enumerate(((1, shear), (1, shear), (2, axial))):
        rod.mass_second_moment_of_inertia[k, k] = rotary * inertia * h
        rod.inv_mass_second_moment_of_inertia[k, k] = 1 / (rotary * inertia * h)
        rod.shear_matrix[k, k], rod.bend_matrix[k, k] = stiff, bending
    return rod


def bearable(numbers, elements):
    """Step [s] of the Verlet method by a bound on the highest frequency: a wave of strain, or
    the turn of an element against its neighbours and its own shear."""
    length, axial, shear, bending, mass, inertia = numbers
    h = length / elements
    turn = (4 * bending / h**2 + shear) / inertia
    return 2 / np.sqrt(max(4 * axial / (mass * h**2), 4 * shear / (mass * h**2) + turn))


def timed(make, request, numbers, seen):
    """What is seen every `save_dt`, and the times that it took; steps are of at most `share`
    of the one that is bearable."""
    largest = request["share"] * bearable(numbers, request["elements"])
    every = int(np.ceil(request["save_dt"] / largest))
    saves = round(request["duration"] / request["save_dt"])
    step, runs, found = np.float64(request["save_dt"] / every), [], []
    stepper, scene = ea.PositionVerlet(), make()[0]
    start, now = clock(), np.float64(0.0)
    for _ in range(WARM_UP):
        now = stepper.step(scene, now, step)
    first = clock() - start
    for _ in range(request["repeats"]):
        scene, rod = make()
        start, now, found = clock(), np.float64(0.0), []
        for _ in range(saves):
            for _ in range(every):
                now = stepper.step(scene, now, step)
            found.append(seen(rod))
        runs.append(clock() - start)
    return {"compile_s": first, "runs": runs, "step": float(step)}, np.array(found)


def flight(request, arrays):
    """Places of both ends every `save_dt`: the rod of Simo and Vu-Quoc under a pulse."""

    def make():
        scene = Scene()
        rod = bar(request["elements"], arrays["bar"], arrays["base"], arrays["axes"])
        scene.append(rod)
        pulse = arrays["wrench"], arrays["times"], arrays["shares"]
        scene.add_forcing_to(rod).using(Pulse, *pulse)
        scene.finalize()
        return scene, rod

    def seen(rod):
        return rod.position_collection[:, [0, -1]].T.copy()

    answer, ends = timed(make, request, arrays["bar"], seen)
    return answer, {"ends": ends}


class Turned(ea.ConstraintBase):
    """The first node stays, the first element turns about z as a function of time."""

    def __init__(self, *fixed, rise, speed, **options):
        super().__init__(**options)
        self.place, self.directors = (np.array(x) for x in fixed)
        self.rise, self.speed = rise, speed

    def constrain_values(self, system, time):
        wave = 2 * np.pi / self.rise
        angle = self.speed / self.rise * (time**2 / 2 + (np.cos(wave * time) - 1) / wave**2)
        if time >= self.rise:
            angle = self.speed * (time - self.rise / 2)
        c, s = np.cos(angle), np.sin(angle)
        system.position_collection[:, 0] = self.place
        # rows are directors, turned by the transpose
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        system.director_collection[:, :, 0] = self.directors @ turn

    def constrain_rates(self, system, time):
        wave, late = 2 * np.pi / self.rise, time >= self.rise
        spin = self.speed / self.rise * (time - np.sin(wave * time) / wave)
        about = np.array([0.0, 0.0, self.speed if late else spin])
        system.velocity_collection[:, 0] = 0.0
        system.omega_collection[:, 0] = self.directors @ about


def spin(request, arrays):
    """Tips every `save_dt` of an arm along x whose base turns about z."""
    rise, speed = arrays["turn"]

    def make():
        scene = Scene()
        rod = bar(request["elements"], arrays["bar"], np.zeros(3), np.eye(3))
        scene.append(rod)
        scene.constrain(rod).using(
            Turned, constrained_position_idx=(0,), constrained_director_idx=(0,),
            rise=rise, speed=speed,
        )  # fmt: skip
        scene.finalize()
        return scene, rod

    def seen(rod):
        return rod.position_collection[:2, -1].copy()

    answer, tips = timed(make, request, arrays["bar"], seen)
    return answer, {"tips": np.concatenate([seen(make()[1])[None], tips])}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text())
    arrays = dict(np.load(folder / "request.npz"))
    answer, results = globals()[request["task"]](request, arrays)
    (folder / "answer.json").write_text(json.dumps(answer))
    np.savez(folder / "answer.npz", **results)
