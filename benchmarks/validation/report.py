"""`python -m benchmarks validation`: what is predicted of measured robots, and how well."""

import argparse
from pathlib import Path

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.discover import HERE
from benchmarks.validation import beam, tensile, tentacle, tentacle_film
from sorojax import view
from sorojax.units import kPa, mm

PAGE = HERE / "results" / "validation.html"
FILM = HERE / "results" / "tentacle.gif"
BAR = 8.0  # mm, mean marker error of poses that the fit has not seen
PEERS = (
    "soromox, section Va of its paper's results, stored arrays: 36.8 mm before a fit, 15.8 mm "
    "with E, nu and density fitted (315 kPa, 0.45, 1318 kg/m3), 6.4 mm with a neural residual "
    "force added, on the kind of poses that it was fitted to"
)
PARTS = ("tentacle", "beam", "tensile")
COLUMNS = ("data", "fitted", "predicted", "error", "measurement", "peers")
Line = tuple[str, str, str, str, str, str]


def main(argv: list[str] | None = None) -> int:
    arguments = _parser().parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    if arguments.poses is not None:
        return of_poses(arguments.poses)
    lines, sections = [], []
    chosen = {arguments.only} if arguments.only else PARTS
    if "tentacle" in chosen:
        found, section = of_tentacle()
        lines += found
        sections.append(section)
    if "beam" in chosen:
        found, section = of_beam(arguments.tip_load)
        lines += found
        sections.append(section)
    if "tensile" in chosen:
        found, section = of_tension()
        lines += found
        sections.append(section)
    print("\n" + table(lines))
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(
        view.html_report(
            "Measured robots, predicted",
            sections,
            lead="Measurements are those of others, named in each part, which says what was "
            "fitted too.",
        )
    )
    print(f"\n{PAGE}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks validation", description=__doc__
    )
    parser.add_argument("only", nargs="?", choices=PARTS, help="default: all")
    parser.add_argument(
        "--poses", type=Path, metavar="FILE",
        help="fit the tentacle to the poses that are shipped and predict those of FILE",
    )  # fmt: skip
    parser.add_argument(
        "--tip-load", type=float, metavar="N", help="predict the beam with this load too"
    )
    return parser


def table(lines: list[Line]) -> str:
    """The lines as text, one block for each, columns by name."""
    blocks = []
    for line in lines:
        rows = zip(COLUMNS, line, strict=True)
        blocks.append("\n".join(f"{name:<12} {text}" for name, text in rows if text))
    return "\n\n".join(blocks)


def _numbers(lines: list[Line]) -> list[view.Number]:
    return [
        view.Number(f"{line[0]}: {name}", text)
        for line in lines
        for name, text in zip(COLUMNS[1:], line[1:], strict=True)
        if text
    ]


def of_poses(file: Path) -> int:
    """Fit the shipped poses, predict those of `file`, print the errors of all markers."""
    record = tentacle.read(file)
    errors = tentacle.errors(tentacle.fit().parameters, record) / mm
    print(f"{'tension [N]':>16}  errors of markers 1 to 4 [mm]  mean")
    for tension, row in zip(record.tension, errors, strict=True):
        pull = " ".join(f"{x:7.3f}" for x in tension)
        print(f"{pull:>16}  {' '.join(f'{x:6.1f}' for x in row)}  {row.mean():6.1f}")
    each = " ".join(f"{x:.1f}" for x in errors.mean(axis=0))
    print(
        f"mean of {len(errors)} poses {errors.mean():.2f} mm, by marker {each}, bar {BAR:g} mm"
    )
    return 0


def of_tentacle() -> tuple[list[Line], view.Section]:
    record = tentacle.read()
    found = tentacle.fit()
    p = found.parameters
    errors = tentacle.errors(p, record) / mm
    print(found)
    left = tentacle.leave_pairs_out(p)
    worst = " and ".join(str(k + 1) for k in left.pairs[int(np.argmax(left.unknown))])
    known, unknown = left.known / mm, left.unknown / mm
    lines = [
        (
            "tendon-driven silicone tentacle, 14 poses (soromox, MIT)",
            f"{len(found.names)} physical parameters on 12 poses",
            f"the other 2, for {len(left.pairs)} pairs",
            f"mean marker error: median {np.median(unknown):.1f} and mean "
            f"{unknown.mean():.1f} mm over pairs, worst {unknown.max():.1f} mm "
            f"(poses {worst}), {100 * np.mean(unknown < BAR):.0f} % of pairs below {BAR:g} mm; "
            "median "
            f"{np.median(known):.1f} mm and worst {known.max():.1f} mm if it is known in which "
            "recording marker 2 slipped",
            f"below {tentacle.NOISE / mm:g} mm",
            PEERS,
        ),
        (
            "the same",
            f"{len(found.names)} physical parameters on 14 poses",
            "nothing: what is left of the fit",
            f"mean marker error {errors.mean():.1f} mm, worst {errors.max():.1f} mm, by marker "
            + ", ".join(f"{x:.1f}" for x in errors.mean(axis=0)),
            "",
            "",
        ),
    ]
    text = (
        "A rod of two tapered links, its equilibrium under two tendons, and motion capture "
        "(poses and geometry: soromox, section Va of its paper's results, MIT licence). Red: "
        "measured markers; dark: predicted ones. The table ends with the parameters and their "
        "standard deviations from the fit to all poses."
    )
    deviations = ravel_pytree(found.standard_errors)[0]
    values = zip(found.names, ravel_pytree(p)[0], deviations, strict=True)
    fitted = [
        view.Number(name, f"{x:.4g} +- {deviation:.2g}", tentacle.UNITS[name.split("[")[0]])
        for name, x, deviation in values
    ]
    film = tentacle_film.film(p, record)
    FILM.parent.mkdir(exist_ok=True)
    print(film.save(FILM))
    pictures = [
        (
            "Fitted rod and measured markers",
            view.show(tentacle_film.scene(p, record), view="iso"),
        ),
        (f"All {len(record.tension)} poses, tensions between them interpolated", film),
    ]
    return lines, view.Section("Tentacle", text, pictures, _numbers(lines) + fitted)


def of_beam(tip_load: float | None) -> tuple[list[Line], view.Section]:
    lines, pictures = [], []
    for name, fitted, body in _beam_laws():
        for load in (*beam.FILES, *(() if tip_load is None else (tip_load,))):
            swing, time, height = beam.predict(body, load)
            repeats = beam.measured(load) if load in beam.FILES else []
            lines.append(
                (
                    f"Dragon Skin 10 beam, {load:.2f} N at the tip (diffPD_sim2real, MIT)",
                    fitted,
                    _told(swing),
                    _beam_errors(swing, repeats),
                    _beam_measured(repeats),
                    "",
                )
            )
            pictures.append((f"{name}, {load:.2f} N at the tip", _curve(load, time, height)))
    text = (
        "A clamped beam of 100 x 30 x 30 mm in plane stress, released from the horizontal "
        "(records: srl-ethz/diffPD_sim2real, MIT licence, Copyright 2021 Soft Robotics Lab, "
        "ETH Zurich; arXiv:2201.12560). The losses of a Kelvin-Voigt viscosity fall with the "
        "frequency, those of this rubber hardly do: a spectrum of two branches has both."
    )
    return lines, view.Section("Beam", text, pictures, _numbers(lines))


def _told(swing: beam.Swing) -> str:
    return (
        f"drop {swing.drops.mean():.2f} mm, frequency {swing.frequency:.2f} Hz, damping ratio "
        f"{swing.ratio:.3f}"
    )


def _beam_laws() -> list[tuple[str, str, beam.Body]]:
    """Name of each law, what was fitted, and the beam."""
    young, viscosity = beam.fitted()
    slow, spectrum = beam.fitted_spectrum()
    shares = " and ".join(f"{float(g):.3f}" for g in spectrum.shares)
    times = " and ".join(f"{1e3 * float(tau):.1f}" for tau in spectrum.times)
    return [
        (
            "Kelvin-Voigt",
            f"E {young / 1e3:.0f} kPa from the drop and viscosity {viscosity:.0f} Pa s from "
            "the damping ratio at 0 N",
            beam.kelvin_voigt(young, viscosity),
        ),
        (
            "two branches",
            f"E {slow / 1e3:.0f} kPa from the drops and shares {shares} of branches of {times} "
            "ms from the damping ratios at both loads",
            beam.viscoelastic(slow, spectrum),
        ),
    ]


def _beam_errors(swing: beam.Swing, repeats: list[beam.Swing]) -> str:
    if not repeats:
        return "not measured"
    drops = np.mean([x.drops for x in repeats], axis=0)
    frequency = np.mean([x.frequency for x in repeats])
    ratio = np.mean([x.ratio for x in repeats])
    return (
        f"drop {np.abs(swing.drops - drops).max():.2f} mm at most, frequency "
        f"{100 * (swing.frequency / frequency - 1):+.1f} %, damping ratio "
        f"{100 * (swing.ratio / ratio - 1):+.0f} %"
    )


def _beam_measured(repeats: list[beam.Swing]) -> str:
    return "; ".join(
        f"drop {x.drops.mean():.2f} mm, {x.frequency:.2f} Hz, {x.ratio:.3f}" for x in repeats
    )


def _curve(load: float, time, height):
    """Height of the tip after the release, measured and predicted, as a figure."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 3.0), layout="constrained")
    for name in beam.FILES.get(load, ()):
        own, drop = beam.released(*beam.read(beam.FOLDER / name))
        axes.plot(own, -drop, color="#c8553d", lw=0.8, label="measured")
    axes.plot(time, height - height[0], color="#0b6e99", lw=1.2, label="predicted")
    axes.set(xlabel="time after the release [s]", ylabel="height [mm]", xlim=(0, time[-1]))
    axes.legend()
    plt.close(figure)
    return figure


def of_tension() -> tuple[list[Line], view.Section]:
    lines, numbers = [], []
    for rubber in tensile.STRESS:
        told = _tension_errors(rubber)
        lines.append(
            (
                f"{rubber} in tension, 8 points (Marechal et al. 2021, ODbL)",
                f"a law to 6 points up to {100 * tensile.FITTED_TO:.0f} %",
                "the stress at 250 and 300 %",
                "; ".join(f"{name}: {text}" for name, text in told.items()),
                "1 % between specimens, more between batches",
                "",
            )
        )
        numbers += [view.Number(f"{rubber}, {name}", text) for name, text in told.items()]
    text = (
        "Stable laws of one term (Ogden) or three (Yeoh), fitted to the points up to 200 % "
        "strain. Data: Marechal et al., Soft Robotics 8, 2021, doi:10.1089/soro.2019.0115 "
        "(Open Database License 1.0); specimens differ by 1 %, batches by more. Rubber hardly "
        "changes its volume: at a Poisson ratio of 0.4999 a bar has the fitted curve, at the "
        "usual 0.49 it is softer at large strain. Below: stress over measured stress."
    )
    picture = ("Measured points, and laws that have seen those up to 200 %", _tension())
    return lines, view.Section("Tension", text, [picture], numbers)


def _tension_errors(rubber: str) -> dict[str, str]:
    """Relative errors of the stress, by what they are of."""
    later, told = tensile.STRAIN > tensile.FITTED_TO, {}
    for name, model in tensile.MODELS.items():
        error = 100 * tensile.predict(rubber, model).error
        told[f"{name} at 250 and 300 %"] = " and ".join(f"{x:+.1f} %" for x in error[later])
    ratios = (tensile.RATIO, tensile.USUAL_RATIO)
    errors = [100 * tensile.predict(rubber, tensile.Yeoh, x).error[~later][-1] for x in ratios]
    told[f"Yeoh at 200 %, with Poisson ratios of {ratios[0]:g} and {ratios[1]:g}"] = (
        " and ".join(f"{x:+.1f} %" for x in errors)
    )
    return told


def _tension():
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(2, 3, figsize=(8.4, 4.6), layout="constrained", sharex=True)
    for axes, (rubber, stress) in zip(grid.flat, tensile.STRESS.items(), strict=True):
        strain = 100 * tensile.STRAIN
        axes.axvspan(100 * tensile.FITTED_TO, strain[-1], color="#eef1f4", lw=0)
        for (name, model), color in zip(
            tensile.MODELS.items(), ("#0b6e99", "#7a5195"), strict=True
        ):
            found = tensile.predict(rubber, model).stress
            axes.plot(strain, found / kPa, color=color, lw=1.2, label=name)
        axes.plot(strain, stress / kPa, "o", color="#c8553d", ms=4, label="measured")
        axes.set(title=rubber, xlabel="strain [%]", ylabel="stress [kPa]")
    grid[0, 0].legend()
    plt.close(figure)
    return figure
