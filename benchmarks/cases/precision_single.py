"""What single precision costs in digits and saves in time, kernel by kernel."""

from benchmarks.harness import Row, measure_calls
from benchmarks.single import KERNELS, error, evaluate, kernel


def rows():
    for called in KERNELS:
        asked, settings = kernel(called), {"kernel": called}
        for name, single in (("double", False), ("single", True)):
            timing = measure_calls(lambda k=asked, s=single: evaluate(k, s))
            checked = {"error": error(asked), "bar": asked.bound} if single else {}
            yield Row(
                "sorojax", settings | {"precision": name}, **timing.columns(), **checked,
                bar_on="error", reference="the same kernel in double precision",
            )  # fmt: skip
