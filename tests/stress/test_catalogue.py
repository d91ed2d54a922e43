"""Every case of the catalogue has a test."""

import re
from pathlib import Path

from tests.stress.catalogue import CASES

MARK = re.compile(r"pytest\.mark\.stress\(([\d, ]+)\)")


def test_every_case_has_a_test():
    marked = set()
    for file in Path(__file__).parent.parent.rglob("test_*.py"):
        for found in MARK.findall(file.read_text(encoding="utf-8")):
            marked |= {int(number) for number in found.split(",")}
    assert marked == set(CASES)
