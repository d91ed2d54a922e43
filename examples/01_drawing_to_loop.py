"""From a drawing to a closed loop: bellows actuator, pressure, strain modes, rod, PID."""

import sys

import jax
import jax.numpy as jnp

import sorojax as sj
from sorojax.units import deg, kPa, ml, mm


def main(quick: bool = False) -> dict[str, float]:
    actuator = sj.robots.BellowsActuator()
    mesh = sj.mesh.triangulate(actuator.body(), size=(1.2 if quick else 0.8) * mm, order=2)
    rubber = sj.material.presets.dragon_skin_30()
    problem = sj.fem.problem(
        mesh,
        rubber,
        kinematics=sj.fem.PlaneStrain(thickness=20 * mm),
        supports=(sj.fem.Fixed(sj.mesh.nodes_where(mesh, lambda p: p[0] < 1e-9)),),
        loads=(sj.fem.Pressure(sj.mesh.facets_on(mesh, actuator.chambers()), name="air"),),
    )
    path = sj.fem.solve_path(problem, air=jnp.linspace(0, 10 * kPa, 11))

    line = sj.reduction.Line([0.0, 1 * mm], [actuator.length, 1 * mm])
    backbone = sj.reduction.strain_along(path, line)
    basis = sj.reduction.pod_basis(backbone, modes={"kappa_z": 3, "sigma_x": 1})
    fit = sj.reduction.identify(path, basis, backbone, line)
    rod = sj.rod.rod(sj.SE2(), basis, fit.section, sj.rod.elastic(rubber), length=fit.length)

    body = sj.systems.RodBody(rod, (fit.elastic, fit.pressure, fit.damping(0.02)))
    target = sj.systems.SmoothRamp([0.0, 0.8], [0.0, -25 * deg])
    pid = sj.systems.PID(-8 * kPa, integral_gain=-60 * kPa, derivative=-0.8 * kPa, low=0.0)
    loop = sj.systems.Network(
        blocks={
            "target": sj.systems.Source(target, unit="rad"),
            "pid": pid,
            "valve": sj.systems.Regulator(1.5e-8, integral_gain=3e-8, max_flow=3e-5),
            "air": sj.systems.Reservoir(dead_volume=2 * ml),
            "body": body,
        },
        wires={
            "pid.reference": "target.value",
            "pid.measurement": "body.tip_angle",
            "valve.setpoint": "pid.command",
            "valve.pressure": "air.pressure",
            "air.mass_flow": "valve.mass_flow",
            "air.volume": "body.volume",
            "air.volume_rate": "body.volume_rate",
            "air.compliance": "body.compliance",
            "body.pressure": "air.pressure",
        },
    )
    film = sj.systems.simulate(loop, 2.0)
    return {
        "stiffness misfit": float(fit.stiffness_error),
        "angle at the end [deg]": float(film["body.tip_angle"][-1] / deg),
        "pressure at the end [kPa]": float(film["air.pressure"][-1] / kPa),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    for name, value in main(quick="--quick" in sys.argv).items():
        print(f"{name:<28} {value:.5g}")
