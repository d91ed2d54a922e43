"""Co-design of a tendon finger: its body and what pulls on it, found together or in turn.

A finger of Dragon Skin 30 hangs from its base. Two tendons are to take its tip past three
targets in one motion of 0.6 s. At rest two tensions reach a surface, on which three points do
not lie in general; the body decides which surface. Its ten numbers are the radii at base and
tip and the places of both tendons in the first and the last section; twelve more are the
tensions at six knots. From the same random bodies and equal tensions Adam changes all numbers
together, or in turn: the body under these tensions with half of the gradients, then, with the
other half, the tensions.

Together 7 of 8 starts end at the targets; what is left is the price of the tensions. In turn
the body brings the tip between the targets, and tensions cannot make up for it: with four times
as many gradients the median stays at 718 mm^2. It is 685, together 0.28, where the first
tensions go from one tendon to the other. Four rounds of turns with as many gradients end at
9.6. Steps a quarter as long move the tips by 0.26 mm at most.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

import sorojax as sj
from sorojax.units import mm

TARGETS = np.array([[120, 70, 30], [90, 20, 100], [130, -60, 40]]) * mm  # x is down
END, STEPS = 0.6, 120  # s, of the motion; steps
TENDONS, KNOTS, MOST = 2, 6, 4.0  # N, the greatest tension
EFFORT = 0.1  # mm^2 of mean squared miss for a mean squared tension of 1 N^2


def make_finger(design):
    """The rod and the routes of its tendons; all numbers of a design lie between 0 and 1."""
    base, tip = np.array([4, 2]) * mm * (1 + design["radii"])
    rubber = sj.rod.elastic(sj.material.presets.dragon_skin_30())
    basis = sj.rod.chebyshev(kappa_x=2, kappa_y=3, kappa_z=3)
    section = sj.rod.taper(sj.rod.circle, base, tip)
    finger = sj.rod.rod(sj.SE3(), basis, section, rubber, length=180 * mm, nodes=10)
    shares = 1.2 * design["places"] - 0.6  # of the radius: tendon, end, y and z
    return finger, [sj.rod.Converging(base * first, tip * last) for first, last in shares]


def tensions(design, t):
    """Of the tendons [N], from one knot to the next by half a wave of the cosine."""
    away = jnp.clip(t / END * KNOTS - np.arange(1.0, KNOTS + 1), -1, 1)
    return MOST * jnp.cos(np.pi / 2 * away) ** 2 @ design["pull"]


def move(design, saves=3):
    """The motion, and the tip at the saved moments [m]."""
    finger, routes = make_finger(design)
    pulled, rest = sj.rod.Tendons(routes, lambda t: tensions(design, t)), jnp.zeros(8)
    forces = pulled, sj.rod.Gravity([9.81, 0.0, 0.0]), sj.rod.Damping(0.03)
    span = {"step": END / STEPS, "saves": saves, "every": STEPS // saves}
    path = sj.rod.rollout(finger, rest, rest, forces, **span)
    poses = jax.vmap(lambda q: sj.rod.forward_kinematics(finger, q, jnp.ones(1)))(path.q)
    return path, poses[1:, 0, :3, 3]


def cost(design, tips):
    """Mean squared miss of the targets [mm^2], and the price of the tensions."""
    miss = jnp.sum(((tips - TARGETS) / mm) ** 2, axis=1)
    return jnp.mean(miss) + EFFORT * jnp.mean((MOST * design["pull"]) ** 2)


@jax.jit
def total(designs):
    """Of all starts: what changes one does not change another, nor does Adam."""
    return jnp.sum(jax.vmap(lambda design: cost(design, move(design)[1]))(designs))


def improve(designs, steps, free):
    """`designs` after so many steps of Adam in the numbers that are `free`, within bounds."""

    def within(change, x):
        return jnp.clip(x + change, 0, 1) - x

    adam = optax.adam(optax.cosine_decay_schedule(0.05, steps))
    bounded = optax.chain(adam, optax.stateless(within))
    return sj.design.minimise(
        total, designs, optimiser=bounded, steps=steps, tolerance=0.0,
        change_gradient=lambda _, slope: {k: slope[k] * float(k in free) for k in slope},
    ).design  # fmt: skip


def main(quick: bool = False, picture: str | Path | None = None) -> dict[str, float]:
    count, steps = (2, 100) if quick else (8, 300)
    random = jax.random.uniform(jax.random.key(0), (count, 2 + 4 * TENDONS))
    starts = {"radii": random[:, :2], "places": random[:, 2:].reshape(count, TENDONS, 2, 2)}
    starts["pull"] = jnp.full((count, KNOTS, TENDONS), 0.25)
    body = improve(starts, steps // 2, ("radii", "places"))
    found = {"start": starts, "body alone": body}
    found["in turn"] = improve(body, steps // 2, ("pull",))
    found["together"] = improve(starts, steps, starts)
    look = jax.jit(jax.vmap(lambda design: move(design, saves=60)))
    films = {name: look(designs) for name, designs in found.items()}
    costs = {k: jax.vmap(cost)(x, films[k][1][:, 19::20]) for k, x in found.items()}
    if picture is not None:
        draw(found, films, costs, picture)
    told = {"starts": count, "better together": jnp.sum(costs["together"] < costs["in turn"])}
    for name, values in costs.items():
        ends = {"median": jnp.median(values), "least": min(values), "most": max(values)}
        told |= {f"{name}: {end} cost [mm^2]": value for end, value in ends.items()}
    ended = [path.status == sj.Status.successful for path, _ in films.values()]
    told["motions that ended well"] = np.sum(ended)
    return {name: float(value) for name, value in told.items()}


def draw(found, films, costs, file) -> None:
    """The start of median cost in turn, seen from two sides; routes, tensions, costs."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Circle
    from matplotlib.patheffects import withStroke

    ways, tendons = {"together": "#1d6996", "in turn": "#e17c05"}, ("#c1121f", "#2b9348")
    shown = int(jnp.argsort(costs["in turn"])[(len(costs["in turn"]) - 1) // 2])
    designs = {way: jax.tree.map(lambda x: x[shown], found[way]) for way in ways}
    tips = {way: np.concatenate([[[180, 0, 0]], films[way][1][shown] / mm]) for way in ways}
    finger, routes = make_finger(designs["together"])
    s = jnp.linspace(0.0, 1.0, 150)
    base, tip = np.array([4, 2]) * (1 + np.asarray(designs["together"]["radii"]))  # mm
    radius = base + (tip - base) * np.asarray(s)
    offsets = [np.asarray(jax.vmap(route.offset)(s)) / mm for route in routes]
    figure = plt.figure(figsize=(7.2, 7.0), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.35, 1))
    above, below = (figure.add_subfigure(grid[k]) for k in (0, 1))

    views = [above.add_subplot(1, 2, k) for k in (1, 2)]
    for axis, side in zip(views, (1, 2), strict=True):
        for k, share in ((20, 0.15), (40, 0.3), (60, 0.5)):
            q = films["together"][0].q[shown, k]
            poses = np.asarray(sj.rod.forward_kinematics(finger, q, s))
            middle = poses[:, :3, 3] / mm
            tone = 1 - share * (1 - np.array(to_rgb(ways["together"])))
            for rim, shade in ((0.8, ways["together"]), (0.0, tone)):
                for point, r in zip(middle, radius + rim, strict=True):
                    axis.add_patch(Circle((point[side], point[0]), r, color=shade, lw=0))
            for offset, colour in zip(offsets, tendons, strict=True):
                line = middle + np.einsum("sij,sj->si", poses[:, :3, 1:3], offset)
                axis.plot(line[:, side], line[:, 0], color=colour, lw=1)
        for way, dashes in (("in turn", "--"), ("together", "-")):
            way_of_tip = tips[way][:, [side, 0]]
            axis.plot(*way_of_tip.T, dashes, color=ways[way], lw=1.8, label=f"tip, {way}")
            axis.plot(*way_of_tip[20::20].T, "o", color=ways[way], ms=6, mec="white", mew=0.8)
        for k, target in enumerate(TARGETS[:, [side, 0]] / mm):
            axis.plot(*target, "o", mfc="none", mec="black", ms=13, mew=1.4)
            place, text = (9, 7 if k < 2 else -13), f"{(k + 1) * END / 3:.1f} s"
            label = axis.annotate(
                text, target, place, textcoords="offset points", weight="bold"
            )
            label.set_path_effects([withStroke(linewidth=3, foreground="white")])
        axis.set(aspect="equal", xlabel=f"{'xyz'[side]} [mm]", ylim=(200, -8), xlim=(-115, 135))
        axis.spines[["top", "right"]].set_visible(False)
    views[0].set(ylabel="down [mm]", title="from the front")
    views[1].set(title="from the side", yticklabels=[])
    views[1].legend(frameon=False, loc="lower left", fontsize=9)

    routed, pulled, spread = below.subplots(1, 3, width_ratios=(1, 1.25, 0.8))
    for k, middle in enumerate((0, 24)):
        routed.fill_between(s * 180, middle - radius, middle + radius, color="#d5e3ea", lw=0)
        for offset, colour in zip(offsets, tendons, strict=True):
            routed.plot(s * 180, middle + offset[:, k], color=colour, lw=1.4)
    routed.set(title="routes: z above, y below [mm]", xlabel="along the finger [mm]")
    routed.set(xlim=(0, 180), xticks=(0, 90, 180))
    routed.set_yticks([-5, 0, 5, 19, 24, 29], 2 * ["-5", "0", "5"])
    time = np.linspace(0, END, 200)
    for way, dashes in (("together", "-"), ("in turn", "--")):
        pull = jax.vmap(lambda t, way=way: tensions(designs[way], t))(time)
        for line, colour in zip(pull.T, tendons, strict=True):
            pulled.plot(time, line, dashes, color=colour, lw=1.6)
    for k in (1, 2, 3):
        pulled.axvline(k * END / 3, color="black", lw=0.6, ls=":")
    pulled.set(
        title="tensions [N], in turn dashed", xlabel="time [s]", xlim=(0, END), ylim=(0, None)
    )
    for pair in zip(*(np.asarray(costs[way]) for way in ways), strict=True):
        spread.plot([0, 1], pair, color="#adb5bd", lw=1, zorder=1)
    for place, (way, colour) in enumerate(ways.items()):
        spread.plot(0 * costs[way] + place, costs[way], "o", color=colour, ms=6)
    spread.set(title="costs [mm$^2$]", yscale="log", xlim=(-0.4, 1.4))
    spread.set_xticks([0, 1], list(ways))
    for axis in (routed, pulled, spread):
        axis.title.set_size(10)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(Path(file), dpi=130, bbox_inches="tight")
    plt.close(figure)

    from sorojax import view

    hang = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # x is down
    ceiling = view.scene_of(sj.sdf.Box([-8 * mm, -20 * mm, -20 * mm], [0.0, 20 * mm, 20 * mm]))
    marks = view.Dots(TARGETS, "#1f2430", 8.0)

    def scene(k):
        """The finger with its tendons, the targets, and where the tip has been."""
        drawn = view.scene_of(
            finger, films["together"][0].q[shown, k], forces=(sj.rod.Tendons(routes),),
            colours={"rod": "#9ec5dc"},
        )  # fmt: skip
        gone = view.Lines([tips["together"][: k + 2] * mm], ways["together"], 2.0)
        told = view.Scene((marks, gone) if k else (marks,))
        return view.place(view.merge_scenes(drawn, ceiling, told), hang)

    moving = view.Track(np.linspace(0, END, 61), scene)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-60.0, 12.0)}
    film = view.animate(moving, speed=0.15, fps=15.0, title="Past three targets", **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    file = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, file).items():
        print(f"{name:<40} {value:.4g}")
