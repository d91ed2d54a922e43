"""A network as a diffrax term: any solver and adjoint of diffrax, here three of each."""

import diffrax as dfx
import jax
import jax.numpy as jnp

import sorojax as sj
from sorojax.units import kPa, mm

SOLVERS = {"Tsit5": dfx.Tsit5(), "Dopri5": dfx.Dopri5(), "Kvaerno5": dfx.Kvaerno5()}
ADJOINTS = {
    "checkpoints": dfx.RecursiveCheckpointAdjoint(),
    "backsolve": dfx.BacksolveAdjoint(),
    "forward": dfx.ForwardMode(),
}


def finger(modulus) -> sj.systems.Network:
    """A finger that is let go, by the modulus of its rubber [Pa]."""
    rod = sj.rod.rod(
        sj.SE2(),
        sj.rod.constant("kappa_z"),
        sj.rod.circle(5 * mm),
        length=100 * mm,
        young_modulus=modulus,
        poisson_ratio=0.4,
        density=1100.0,
        nodes=6,
    )
    body = sj.systems.RodBody(rod, (sj.rod.Damping(0.05), sj.rod.Gravity()), q=[5.0])
    return sj.systems.Network({"finger": body}, {})


def bent(modulus, solver: dfx.AbstractSolver, adjoint: dfx.AbstractAdjoint):
    """Curvature after 0.1 s [1/m]."""
    network = finger(modulus)
    run = dfx.diffeqsolve(
        sj.systems.as_term(network),
        solver,
        t0=0.0,
        t1=0.1,
        dt0=1e-3,
        y0=network.initial_state(),
        args=network,  # what the adjoints differentiate in
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-10),
        adjoint=adjoint,
    )
    last = jax.tree.map(lambda x: x[-1], run.ys)
    return last["finger"]["q"][0]


def slope(solver: dfx.AbstractSolver, adjoint: dfx.AbstractAdjoint):
    """Its derivative in the modulus, per 100 kPa."""
    forward = isinstance(adjoint, dfx.ForwardMode)
    by = (jax.jacfwd if forward else jax.grad)(lambda e: bent(e, solver, adjoint))
    return 100 * kPa * by(jnp.asarray(1000 * kPa))


def main() -> dict[str, float]:
    pairs = [("Tsit5", a) for a in ADJOINTS]
    pairs += [(s, "checkpoints") for s in SOLVERS if s != "Tsit5"]
    return {f"{s}, {a} [1/m]": float(slope(SOLVERS[s], ADJOINTS[a])) for s, a in pairs}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    for name, value in main().items():
        print(f"{name:<28} {value:.7g}")
