"""What single precision costs in digits and saves in time, kernel by kernel."""

from benchmarks.harness import Row, measure_calls, quick
from benchmarks.single import KERNELS, compiled, error, kernel

#: One of each floor; all of them are held to their digits by `make stress`.
FEW = ("sdf normal", "rod.tip_pose", "rod.forward_dynamics", "material.NeoHookean",
       "fem tangent, Quad4", "network of five fingers")  # fmt: skip


def rows():
    for called in KERNELS:
        if called not in FEW and quick(called):
            continue
        asked, settings = kernel(called), {"kernel": called}
        for name, single in (("double", False), ("single", True)):
            timing = measure_calls(compiled(asked, single), repeats=25)
            checked = {"error": error(asked), "bar": asked.bound} if single else {}
            yield Row(
                "sorojax",
                settings | {"precision": name},
                **timing.columns(),
                **checked,
                bar_on="error",
                reference="the same kernel in double precision",
            )
