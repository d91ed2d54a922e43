"""A scene pays only for what it uses."""

import pytest

from benchmarks.scenes import features, operations

CHEAP = ("gravity", "damping", "third dimension", "fluidics", "logging")


@pytest.mark.parametrize(
    "feature", [f for f in features() if f.name in CHEAP], ids=lambda f: f.name
)
def test_what_is_absent_is_not_in_the_program(feature):
    """All features are measured by the benchmark `skip.features`."""
    few, many = operations(feature.without), operations(feature.with_it)
    assert few[0] < many[0] and few[1] < many[1]
