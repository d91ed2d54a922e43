"""Random programs of loops: no abort, the usual answers; and what goes wrong is noticed."""

import pytest

from tests import fuzz_kernels as fuzz


def test_random_programs_give_the_usual_answers():
    counts = fuzz.run(programs=30, seed=0)
    assert counts["programs"] == 30
    assert not [kind for kind in fuzz.BAD if counts[kind]]
    assert counts["kernels"] >= fuzz.ENOUGH * 30


def test_several_threads_compile_and_call_at_once():
    found = [result for _, result in fuzz.explore([*range(30, 42)], threads=4, fault="")]
    assert len(found) == 12
    assert {result["kind"] for result in found} <= {"", "undecided"}


@pytest.mark.parametrize("kind", fuzz.BAD)
def test_what_goes_wrong_is_counted(kind, capsys):
    counts = fuzz.run(programs=3, seed=0, fault=kind)  # the second of them goes wrong
    assert {each: counts[each] for each in fuzz.BAD if counts[each]} == {kind: 1}
    assert counts["programs"] == 3
    assert f"seed [1]: {kind}: " in capsys.readouterr().out
