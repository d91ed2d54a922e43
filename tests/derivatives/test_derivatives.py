"""Every public verb that promises a derivative keeps it: against central differences."""

import importlib
import inspect
import re

import pytest

import sorojax as sj
from tests.derivatives.case import check

FLOORS = {
    floor: importlib.import_module(f"tests.derivatives.{floor}")
    for floor in ("contact", "material", "mesh", "reduction", "rod", "sdf")
}
CASES = [(floor, name) for floor, module in FLOORS.items() for name in module.CASES]


def public(floor):
    package = importlib.import_module(f"sorojax.{floor}")
    for name, value in vars(package).items():
        ours = getattr(value, "__module__", "").startswith("sorojax")
        if ours and inspect.isfunction(value) and not name.startswith("_"):
            yield name


@pytest.mark.parametrize("floor", FLOORS)
def test_every_public_function_is_compared_or_has_a_reason(floor):
    module = FLOORS[floor]
    functions = set(public(floor))
    said = " ".join(name.split(":")[0] for name in module.CASES)
    compared = functions & set(re.findall(r"\w+", said))
    without = [name for names in module.NONE.values() for name in names.split()]
    assert len(without) == len(set(without))
    assert functions - compared == set(without)


@pytest.mark.parametrize(("floor", "name"), CASES)
def test_slope_is_that_of_the_values(floor, name):
    check(FLOORS[floor].CASES[name])
