"""Rubbers with quoted tensile points, fits to tensile tests and those of Sorotoki.

`table()` lists them with what they are good for. The fits are to the soft-robotics
materials database of Marechal et al. (Soft Robotics 8, 2021, doi:10.1089/soro.2019.0115;
Open Database License): uniaxial pull to failure, one rate (450 mm/min), cross-head strain,
mean curves of one batch. The specimens of a batch differ by about 1 %, but batches by far
more: the Dragon Skin 10 of a published beam test (arXiv:2201.12560) is 1.6 times as stiff.
The first 10 % of strain carry the play of the grips. Fits are those of an incompressible
bar: at the usual Poisson ratio of 0.49 the material is softer in tension, by 2 to 4 % at
100 % strain and 5 to 10 % at 200 %; pass `poisson_ratio=0.4999` where that counts. A name
ending in `_full` is an Ogden fit up to failure, stable everywhere; the others are Yeoh fits
up to 300 %, better at moderate strain. Numbers of the `sorotoki_` family are those of its
source code.

Densities of the others are those of the maker's data sheets. A relaxation spectrum is there for
Dragon Skin 10 only, from the swings of one beam: for the others no source with numbers is known
to this table, and none for friction of any of them, which belongs to two surfaces.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sorojax.material import checks
from sorojax.material.hyperelastic import AbstractHyperelastic, bulk_modulus
from sorojax.material.rubbers import (
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Yeoh,
    made_of,
    shear_modulus,
)
from sorojax.material.viscoelastic import Prony, Viscoelastic
from sorojax.units import kPa

MARECHAL = "Marechal et al. 2021, doi:10.1089/soro.2019.0115, ODbL 1.0 / DbCL 1.0"
SOROTOKI = "Sorotoki, Caasenbrood, MIT licence"
FORMLABS = "Formlabs data sheet of Flexible 80A: 6.3 MPa at 100 %, 8.9 MPa at 120 %"
SMOOTH_ON = "Smooth-On data sheet, specific gravity"
BEAM = "swings of a beam, two loads, two repeats: diffPD_sim2real, MIT, arXiv:2201.12560"
ASSUMED = FORMLABS + "; assumed: through both points, none measured below 100 %"

#: Engineering strain [-] and engineering stress [Pa].
DRAGON_SKIN_30_POINTS = (
    np.array([0.5, 1.0, 2.0, 3.0]),
    np.array([214.0, 437.0, 960.0, 1530.0]) * kPa,
)
DRAGON_SKIN_10_POINTS = (
    np.array([0.5, 1.0, 2.0, 3.0]),
    np.array([53.0, 113.0, 272.8, 444.8]) * kPa,
)


class Relaxation(NamedTuple):
    """A spectrum fitted by `fit_spectrum`: `shares` [-] and `times` [s] of its branches, the
    `frequency_range` that was measured [Hz], `relative_rms`, the error of the damping ratios
    [-], and the `source` of the measurement."""

    shares: tuple[float, ...]
    times: tuple[float, ...]
    frequency_range: tuple[float, float]
    relative_rms: float
    source: str


#: Outside of 4 to 8 Hz nothing was measured, and one branch loses less and less there.
DRAGON_SKIN_10_RELAXATION = Relaxation((0.2407,), (0.02405,), (4.29, 7.74), 0.0276, BEAM)


@dataclass(frozen=True)
class Preset:
    """Numbers of a rubber called `name` and what is known about them.

    `coefficients` are those of `model` in the order of its fields [Pa] (for `Ogden` the
    moduli, then the exponents), `bulk_modulus` [Pa] is given where the source has one,
    and `density` is in kg/m^3; `source` says where the numbers are from.
    `strain_range` and `relative_rms` are those of `fit_tensile`; `specimens` went into
    the mean curve, as its resolution shows, and `spread` is the largest deviation of one
    from the mean where it broke. `friction` is the coefficient of Coulomb's law, `relaxation`
    the spectrum of `rubber(name, viscoelastic=True)`. None is not known.
    """

    name: str
    model: type[AbstractHyperelastic]
    coefficients: tuple[float, ...]
    density: float | None
    source: str
    strain_range: tuple[float, float] | None = None
    relative_rms: float | None = None
    specimens: int | None = None
    spread: float | None = None
    bulk_modulus: float | None = None
    relaxation: Relaxation | None = None
    friction: float | None = None

    @property
    def density_source(self) -> str | None:
        """Where the density is from; None where it is not known."""
        if self.density is None:
            return None
        return SMOOTH_ON if self.source == MARECHAL else self.source

    @property
    def shear_modulus(self) -> float:
        """Small-strain shear modulus [Pa]."""
        return shear_modulus(self.model, self.coefficients)

    def __str__(self) -> str:
        def percent(value: float | None) -> str:
            return "-" if value is None else f"{100 * value:.1f} %"

        upto = "-" if self.strain_range is None else f"{100 * self.strain_range[1]:.0f} %"
        density = "-" if self.density is None else f"{self.density:g}"
        friction = "-" if self.friction is None else f"{self.friction:g}"
        return (
            f"{self.name:<26s} {self.model.__name__:<12s} {self.shear_modulus / kPa:8.4g} "
            f"{upto:>7s} {percent(self.relative_rms):>6s} {self.specimens or '-':>5} "
            f"{percent(self.spread):>6s} {density:>7} "
            f"{'-' if self.relaxation is None else 'yes':>6} {friction:>8}  {self.source}"
        )


# fmt: off
PRESETS = (
    Preset("ecoflex_00_10", Yeoh, (3605.0, 137.9, -0.1887), 1040.0, MARECHAL,
           (0.045, 3.0), 0.0107, 3, 0.017),
    Preset("ecoflex_00_10_full", Ogden, (5490.0, 2.779), 1040.0, MARECHAL,
           (0.045, 17.091), 0.0153, 3, 0.017),
    Preset("ecoflex_00_30", Yeoh, (7830.0, 103.4, -0.8065), 1070.0, MARECHAL,
           (0.068, 3.0), 0.0078, 1, None),
    Preset("ecoflex_00_30_full", Ogden, (37310.0, 2195.0, 0.9051, 3.261), 1070.0, MARECHAL,
           (0.068, 16.068), 0.0045, 1, None),
    Preset("ecoflex_00_50", Yeoh, (10670.0, 260.6, -3.249), 1070.0, MARECHAL,
           (0.045, 3.0), 0.0071, 2, 0.003),
    Preset("ecoflex_00_50_full", Ogden, (59510.0, 6271.0, 0.5, 3.017), 1070.0, MARECHAL,
           (0.045, 16.409), 0.0063, 2, 0.003),
    Preset("dragon_skin_10", Yeoh, (24290.0, 2250.0, -54.28), 1070.0, MARECHAL,
           (0.045, 3.0), 0.0142, None, None, relaxation=DRAGON_SKIN_10_RELAXATION),
    Preset("dragon_skin_10_full", Ogden, (72860.0, 2.341), 1070.0, MARECHAL,
           (0.045, 10.409), 0.0277, None, None, relaxation=DRAGON_SKIN_10_RELAXATION),
    Preset("dragon_skin_20", Yeoh, (70400.0, 5223.0, -112.7), 1080.0, MARECHAL,
           (0.045, 3.0), 0.0116, 3, 0.005),
    Preset("dragon_skin_20_full", Ogden, (176900.0, 2.399), 1080.0, MARECHAL,
           (0.045, 9.205), 0.0264, 3, 0.005),
    Preset("dragon_skin_30", Yeoh, (100500.0, 6387.0, -149.2), 1080.0, MARECHAL,
           (0.045, 3.0), 0.0109, 3, 0.006),
    Preset("dragon_skin_30_full", Ogden, (202700.0, 2.456), 1080.0, MARECHAL,
           (0.045, 7.091), 0.0183, 3, 0.006),
    Preset("sorotoki_dragon_skin_10", Yeoh, (36e3, 250.0, 23.0), 1070.0, SOROTOKI,
           bulk_modulus=2e6),
    Preset("sorotoki_dragon_skin_30", Yeoh, (153.6e3, 1.6e3, 0.0), 1070.0, SOROTOKI,
           bulk_modulus=2e6),
    Preset("sorotoki_ecoflex_00_10", Yeoh, (3e3, -200.0, 23.0), 1070.0, SOROTOKI,
           bulk_modulus=2e6),
    Preset("sorotoki_ecoflex_00_30", Yeoh, (17e3, -200.0, 23.0), 1070.0, SOROTOKI,
           bulk_modulus=1e6),
    Preset("sorotoki_ecoflex_00_50", Yeoh, (14.5e3, 100.0, 0.0), 1070.0, SOROTOKI,
           bulk_modulus=0.2e6),
    Preset("sorotoki_elastic_50a", Yeoh, (505.6e3, 0.0, 2562.0), 1200.0,
           SOROTOKI + "; Xavier et al. 2021", bulk_modulus=10e6),
    Preset("sorotoki_elastosil_28", Yeoh, (110e3, 20e3, 0.0), 1332.0, SOROTOKI,
           bulk_modulus=2e6),
    Preset("sorotoki_rtv_615", Yeoh, (162.1e3, 14.2e3, 900.0), None, SOROTOKI,
           bulk_modulus=2e6),
    Preset("sorotoki_ninjaflex_85", MooneyRivlin, (0.77e6, 2.94e6), None, SOROTOKI),
    Preset("sorotoki_tpu_90", NeoHookean, (2.464e6,), 1070.0, SOROTOKI,
           bulk_modulus=11.5e6),
    Preset("elastic_80a", NeoHookean, (4.088e6,), None, FORMLABS, (1.0, 1.2), 0.104),
    Preset("flexible_80a", Yeoh, (645.6e3, 288.6e3, 0.0), None, ASSUMED, (1.0, 1.2), 1e-4),
)
# fmt: on


def rubber(name: str, *, poisson_ratio: float | None = None, viscoelastic: bool = False) -> Any:
    """The material of a preset.

    Fits to tensile tests, see `table()` for the sources and how far each is good. The functions
    `dragon_skin_30()`, `ecoflex_00_30()` and so on are the presets used most.

    Args:
        name: As in `table()`, "dragon_skin_20_full" for example.
        poisson_ratio: Poisson's ratio at small strains [-], below 0.5; by default that of the
            source, or 0.49 where it has none.
        viscoelastic: Whether it relaxes, as measured in the range of frequencies that `table()`
            tells.

    Returns:
        The material, with its density if it is known.

    Raises:
        ValueError: If there is no such preset, the ratio is out of range, or no source has
            numbers of its relaxation.

    Example:
        >>> rubber = presets.rubber("dragon_skin_30")
        >>> print(f"{2 * float(rubber.c1) / kPa:.0f} kPa, {float(rubber.density):.0f} kg/m^3")
        201 kPa, 1080 kg/m^3

    Reference:
        Marechal et al., Toward a common framework and database of materials for soft robotics,
        Soft Robotics 8, 2021.
    """
    known = {preset.name: preset for preset in PRESETS}
    if name not in known:
        raise ValueError(
            f"presets.rubber: no preset is called {name!r}, need one of "
            f"{', '.join(known)}. Fit your own with fit_tensile."
        )
    preset = known[name]
    if poisson_ratio is None and preset.bulk_modulus is not None:
        bulk = preset.bulk_modulus
    else:
        ratio = 0.49 if poisson_ratio is None else poisson_ratio
        checks.poisson_ratio("presets.rubber", ratio)
        bulk = bulk_modulus(np.asarray(preset.shear_modulus), ratio)  # type: ignore[arg-type]
    elastic = made_of(preset.model, preset.coefficients, bulk, preset.density)
    return Viscoelastic(elastic, _spectrum(preset)) if viscoelastic else elastic


def _spectrum(preset: Preset) -> Prony:
    if preset.relaxation is None:
        measured = ", ".join(each.name for each in PRESETS if each.relaxation)
        raise ValueError(
            f"presets.rubber: got {preset.name!r} with viscoelastic=True, need one of "
            f"{measured}: of the others no source with numbers is known. Fit a test with "
            "fit_spectrum, and write Viscoelastic(rubber, fit.spectrum)."
        )
    return Prony(preset.relaxation.shares, preset.relaxation.times)


def table() -> str:
    """All presets: shear modulus [kPa], fitted strain, error, specimens, spread, density
    [kg/m^3], whether there is a relaxation spectrum, coefficient of friction, source; then the
    sources of densities and spectra.

    Returns:
        One line for each preset.
    """
    head = (
        f"{'name':<26s} {'model':<12s} {'mu [kPa]':>8s} {'up to':>7s} {'error':>6s} "
        f"{'tests':>5s} {'spread':>6s} {'density':>7s} {'relax.':>6s} {'friction':>8s}  source"
    )
    return "\n".join([head, *map(str, PRESETS), "", *_sources()])


def _sources() -> list[str]:
    """Where densities and spectra are from, and for how many no source is known."""
    found: dict[str, list[str]] = {}
    for preset in PRESETS:
        if preset.density_source is not None:
            found.setdefault(f"density, {preset.density_source}", []).append(preset.name)
        if preset.relaxation is not None:
            low, high = preset.relaxation.frequency_range
            told = f"relaxation, {low:g} to {high:g} Hz, {preset.relaxation.source}"
            found.setdefault(told, []).append(preset.name)
    rows = [f"{told}: {', '.join(names)}" for told, names in sorted(found.items())]
    for what in ("density", "relaxation", "friction"):
        missing = sum(getattr(each, what) is None for each in PRESETS)
        rows.append(f"{what}, no source known: {missing} of {len(PRESETS)}")
    return rows


def ecoflex_00_10(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Ecoflex 00-10 for strains up to 300 %.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("ecoflex_00_10", poisson_ratio=poisson_ratio)


def ecoflex_00_30(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Ecoflex 00-30 for strains up to 300 %.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("ecoflex_00_30", poisson_ratio=poisson_ratio)


def ecoflex_00_50(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Ecoflex 00-50 for strains up to 300 %.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("ecoflex_00_50", poisson_ratio=poisson_ratio)


def dragon_skin_10(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Dragon Skin 10 Medium for strains up to 300 %.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("dragon_skin_10", poisson_ratio=poisson_ratio)


def dragon_skin_20(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Dragon Skin 20 for strains up to 300 %.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("dragon_skin_20", poisson_ratio=poisson_ratio)


def dragon_skin_30(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Dragon Skin 30 for strains up to 300 %.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("dragon_skin_30", poisson_ratio=poisson_ratio)


def flexible_80a(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Formlabs Flexible 80A: an assumption, not a fit. Two moduli through the two points of
    the maker's data sheet, 6.3 MPa at 100 % and 8.9 MPa at 120 % where it breaks; nothing
    public says how stiff it is below. Stands for Elastic 80A, of which no data are public.

    Args:
        poisson_ratio: At small strains [-], below 0.5.

    Returns:
        The material.
    """
    return rubber("flexible_80a", poisson_ratio=poisson_ratio)
