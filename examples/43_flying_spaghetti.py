"""A flexible rod flies off: it tumbles and bends, and keeps its momentum.

Simo and Vu-Quoc, Comput. Meth. Appl. Mech. Eng. 66, 1988. A force and a moment act on one end
for five seconds; then nothing holds the rod. Its stiffness and its mass come from two sections.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import SE3, rod
from sorojax.math.lie import homogeneous
from sorojax.math.ode.steppers import DormandPrince

LENGTH, TILT = 10.0, np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
WRENCH = (0.0, 40.0, 80.0, 8.0, 0.0, 0.0)  # N m, N at the peak


class Pulse(rod.AbstractForce):
    """The wrench on the base, which rises for 2.5 s and falls for as long."""

    wrench: jax.Array

    def __call__(self, t, motion):
        share = jnp.clip(jnp.minimum(t, 5.0 - t) / 2.5, 0, 1)
        base = motion.base
        assert base is not None  # the rod floats
        return (
            share * self.wrench @ jnp.concatenate([base.angular_jacobian, base.linear_jacobian])
        )


def spaghetti(section=None) -> rod.Assembly:
    """The rod, at rest and tilted in the plane; another section for pictures."""
    names = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")
    beam = rod.rod(
        SE3(),
        rod.chebyshev(**{name: 4 if name in names[1:3] else 3 for name in names}),
        # 1e4 N in stretch and shear, 500 N m^2
        section or rod.Section(1.0, 0.05, 0.05, 0.05, 1.0),
        length=LENGTH,
        young_modulus=1e4,
        poisson_ratio=-0.5,
        density=1.0,
        nodes=12,
        mass_section=rod.Section(1.0, 10.0, 10.0, 10.0, 1.0),
    )
    start = homogeneous(jnp.array(TILT), jnp.array([0.0, 8.0, 0.0]))
    return rod.assembly(SE3(), rod=rod.Part(beam, rod.Free(), offset=start))


def main(quick: bool = False, file: Path | None = None) -> dict[str, float]:
    """Ten seconds of flight, and the momentum of its second half."""
    model, every = spaghetti(), 20 if quick else 50
    path = rod.rollout(
        model,
        rod.rest(model),
        jnp.zeros(rod.num_dof(model)),
        (rod.PartForce("rod", Pulse(jnp.array(WRENCH))),),
        step=0.1 / every,
        saves=100,
        every=every,
        stepper=DormandPrince(),
    )
    s = jnp.linspace(0, 1, 41)
    places = jax.vmap(lambda q: rod.forward_kinematics(model, q, s)["rod"][:, :3, 3])(path.q)
    momenta = jax.vmap(lambda q, v: rod.momentum(model, q, v))(path.q[50:], path.v[50:])
    change = jnp.abs(momenta - momenta[:1]).max() / jnp.linalg.norm(momenta[0])
    apart = jnp.linalg.norm(places[:, -1] - places[:, 0], axis=1)
    if file is not None:
        draw(np.asarray(places), path, file)
    return {
        "least distance of the ends over the length": float(apart.min()) / LENGTH,
        "momentum lost in free flight": float(change),
        "impulse over momentum": 20.0 / float(momenta[-1, 3]),
        "ended well": float(path.status == sj.Status.successful),
    }


def draw(places: np.ndarray, path, file: Path) -> None:
    """The rod every half second, from above and from the side; a film of it as a round bar."""
    import matplotlib.pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure, views = plt.subplots(2, 1, figsize=(8, 7), sharex=True, layout="constrained")
    colours = plt.get_cmap("viridis")
    for axis, side in zip(views, (1, 2), strict=True):
        for k, line in enumerate(places[::5]):
            colour = colours(0.95 * k / 20)
            axis.plot(line[:, 0], line[:, side], color=colour, lw=3, solid_capstyle="round")
            axis.plot(*line[0, [0, side]], "o", color=colour, ms=5)
        middle = places.mean(axis=1)
        axis.plot(middle[:, 0], middle[:, side], color="black", lw=1, ls="--")
        axis.set(aspect="equal", ylabel=f"{'xyz'[side]} [m]")
        axis.spines[["top", "right"]].set_visible(False)
    views[0].set_title("every half second; a dot on the end that is pushed, dashed the middle")
    views[1].set_xlabel("x [m]")
    shown = ScalarMappable(Normalize(0, 10), colours)
    figure.colorbar(shown, ax=views, label="time [s]", shrink=0.6)
    figure.savefig(file, dpi=130)
    plt.close(figure)

    from sorojax import view

    bar, middles = spaghetti(rod.circle(0.2)), places.mean(axis=1)
    low, high = places.min(axis=(0, 1)), places.max(axis=(0, 1))
    below = view.scene_of(sj.sdf.Box([low[0], low[1], low[2] - 0.6], [*high[:2], low[2] - 0.4]))

    def scene(k):
        """The bar above a plate that stands still, and the way of its middle."""
        drawn = view.scene_of(bar, path.q[k], colours={"rod": "#e9b44c"})
        end = view.Dots(places[k, :1], "#D55E00", 9.0)
        told = (end, view.Lines([middles[: k + 1]], "#1f2430", 1.5)) if k else (end,)
        return view.merge_scenes(drawn, below, view.Scene(told))

    moving = view.Track(np.asarray(path.time), scene)
    look = {"renderer": "own", "samples": 2, "shadows": True, "view": view.Camera(-70.0, 32.0)}
    title = "A flexible rod flies off"
    film = view.animate(moving, speed=1.5, fps=15.0, size=(720, 420), title=title, **look)
    film.save(Path(file).with_suffix(".webp"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    picture = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, picture).items():
        print(f"{name:<44} {value:.4g}")
