"""Every public verb that promises a derivative keeps it: against central differences."""

import importlib
import inspect

import pytest

from tests.derivatives.case import check

pytestmark = pytest.mark.quick

FLOORS = {
    floor: importlib.import_module(f"tests.derivatives.{floor}")
    for floor in (
        "contact",
        "coupling",
        "design",
        "envs",
        "fem",
        "material",
        "mesh",
        "reduction",
        "robots",
        "rod",
        "sdf",
        "systems",
    )
}
CASES = [
    pytest.param(
        floor, name, marks=pytest.mark.slow if name in getattr(module, "SLOW", ()) else ()
    )
    for floor, module in FLOORS.items()
    for name in module.CASES
]


def public(floor):
    package = importlib.import_module(f"sorojax.{floor}")
    for name, value in vars(package).items():
        ours = getattr(value, "__module__", "").startswith("sorojax")
        if ours and inspect.isfunction(value) and not name.startswith("_"):
            yield name


#: Names before the colon, with commas between them, are those of the verbs that a case shows.
@pytest.mark.parametrize("floor", FLOORS)
def test_every_public_function_is_compared_or_has_a_reason(floor):
    module = FLOORS[floor]
    heads = [part for name in module.CASES for part in name.split(":")[0].split(", ")]
    compared = {head.split()[0] for head in heads}
    without = [name for names in module.NONE.values() for name in names.split()]
    assert len(without) == len(set(without)) and not compared & set(without)
    assert set(public(floor)) - compared == set(without)


@pytest.mark.parametrize(("floor", "name"), CASES)
def test_slope_is_that_of_the_values(floor, name):
    check(FLOORS[floor].CASES[name])
