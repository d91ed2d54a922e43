"""What a case yields, and how it becomes a line of JSON."""

import json
import math
import statistics
from dataclasses import asdict, dataclass, field, replace
from typing import Any

KEYS = (
    "case", "code", "settings", "compile_s", "run_s", "run_s_min", "run_s_max", "error",
    "reference", "bar", "holds",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One code at one setting: what it costs and how wrong it is.

    `bar` is the figure that the project asks for, compared with `bar_on`, one of
    `run_s`, `compile_s` or `error`. A code that could not run has nulls and a reason
    in its settings.
    """

    code: str
    settings: dict[str, Any] = field(default_factory=dict)
    compile_s: float | None = None
    run_s: float | None = None
    run_s_min: float | None = None
    run_s_max: float | None = None
    error: float | None = None
    reference: str | float | None = None
    bar: float | None = None
    bar_on: str = "run_s"

    @property
    def holds(self) -> bool | None:
        """Whether the bar is met; `None` without a bar."""
        if self.bar is None:
            return None
        value = getattr(self, self.bar_on)
        return value is not None and value <= self.bar


@dataclass(frozen=True)
class Timing:
    """Seconds: to compile or to make the first call, and of each later call."""

    compile_s: float
    runs: tuple[float, ...]

    def per(self, calls: int) -> "Timing":
        """The same for programs that hold `calls` calls each."""
        return replace(self, runs=tuple(run / calls for run in self.runs))

    def columns(self) -> dict[str, Any]:
        """The four columns of a `Row`: `Row("sorojax", **timing.columns())`."""
        return {
            "compile_s": self.compile_s,
            "run_s": statistics.median(self.runs),
            "run_s_min": min(self.runs),
            "run_s_max": max(self.runs),
        }


def missing(code: str, reason: str, **settings: Any) -> Row:
    """The row of a code that could not run."""
    return Row(code, settings | {"reason": reason})


def line(case: str, row: Row) -> dict[str, Any]:
    """The JSON object of a row, with exactly the keys `KEYS`."""
    values = asdict(row) | {"case": case, "holds": row.holds}
    if row.bar is not None:
        values["settings"] = row.settings | {"bar_on": row.bar_on}
    return {key: _plain(values[key]) for key in KEYS}


def dumps(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False)


def _plain(value: Any) -> Any:
    """Numbers of any library as Python's own; what is not finite becomes null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)
