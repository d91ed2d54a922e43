"""`python -m benchmarks`: list cases, run some, write JSON lines or a page."""

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import discover, page, suite
from benchmarks.rows import dumps
from benchmarks.runner import run_case
from sorojax._progress import report


def main(argv: list[str] | None = None) -> int:
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["validation"]:
        from benchmarks.validation import report as validation

        return validation.main(argv[1:])
    arguments = _parser().parse_args(argv)
    known = discover.cases(arguments.cases)
    if arguments.list:
        width = max(map(len, known), default=0)
        for name, path in known.items():
            print(f"{name:<{width}}  {discover.description(path)}")
        return 0
    unknown = [name for name in arguments.names if name not in known]
    if unknown:
        print(
            f"benchmarks: no case {', '.join(unknown)}, need one of {', '.join(known)}. "
            "See --list.",
            file=sys.stderr,
        )
        return 2
    names = arguments.names or (suite.quick() if arguments.quick else known)
    if arguments.quick:
        os.environ["SOROJAX_BENCH_QUICK"] = "1"  # for the processes of the cases
    if arguments.cpu:
        os.environ["SOROJAX_BENCH_CPU"] = "1"  # for those of peers too
    chosen = {name: known[name] for name in names}
    left_out = [name for name in known if name not in chosen] if arguments.quick else []
    lines = _to_json(chosen, arguments.json) if arguments.json else _to_page(chosen, left_out)
    failed = [x for x in lines if x["code"] == "sorojax" and "reason" in x["settings"]]
    return 1 if failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="CASE", help="default: all")
    parser.add_argument("--list", action="store_true", help="name the cases and stop")
    parser.add_argument(
        "--quick", action="store_true", help="few cases of every row of the report, few sizes"
    )
    parser.add_argument(
        "--cpu", action="store_true", help="CPU seconds, for a machine that others use"
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write JSON lines there, and nothing else"
    )
    parser.add_argument(
        "--cases", type=Path, default=discover.CASES, help="another folder of cases"
    )
    return parser


def _to_json(chosen: dict[str, Path], file: Path) -> list[dict[str, Any]]:
    lines = []
    with file.open("w") as out:
        for k, (name, path) in enumerate(chosen.items()):
            for line in run_case(name, path):
                print(dumps(line), file=out, flush=True)
                lines.append(line)
            report("benchmarks", k + 1, len(chosen), rows=len(lines))
    return lines


def _to_page(chosen: dict[str, Path], left_out: list[str]) -> list[dict[str, Any]]:
    lines, took, start = [], {}, time.monotonic()
    print(page.HEADER)
    for name, path in chosen.items():
        begin = time.monotonic()
        for line in run_case(name, path):
            print(page.text(line), flush=True)
            lines.append(line)
        took[name] = time.monotonic() - begin
        print(f"{name}: {took[name]:.0f} s", flush=True)
    folder = discover.HERE / "results"
    folder.mkdir(exist_ok=True)
    target = folder / "index.html"
    target.write_text(page.html(lines, took, left_out))
    print(f"\n{len(chosen)} cases in {time.monotonic() - start:.0f} s: {target}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
