"""What the project makes public, package by package, and what is written about it."""

import importlib
import inspect
import pkgutil
import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property
from typing import Any

CORE = (
    "sorojax", "sorojax.sdf", "sorojax.mesh", "sorojax.material", "sorojax.material.presets",
    "sorojax.contact", "sorojax.fem", "sorojax.rod", "sorojax.coupling", "sorojax.reduction",
    "sorojax.systems", "sorojax.design", "sorojax.robots", "sorojax.envs", "sorojax.io",
    "sorojax.view", "sorojax.vision", "sorojax.sweep", "sorojax.math", "sorojax.units",
)  # fmt: skip
BENCH = ("sorojax_hardware", "sorojax_board")
PACKAGES = CORE + BENCH


@dataclass(frozen=True, eq=False)
class Public:
    """One public name: `path` is how a user writes it, `source` the module that defines it."""

    path: str
    package: str
    value: Any

    @property
    def name(self) -> str:
        return self.path.rpartition(".")[2]

    @cached_property
    def plain(self) -> Any:
        """The object without the checks of its arguments."""
        return inspect.unwrap(self.value)

    @property
    def source(self) -> str:
        return getattr(self.plain, "__module__", None) or self.package

    @property
    def kind(self) -> str:
        """`class`, `function` or `data`."""
        if inspect.isclass(self.value):
            return "class"
        return "function" if inspect.isroutine(self.plain) or _called(self.value) else "data"

    @property
    def text(self) -> str:
        """The docstring; none of its own has a datum, whose class would answer."""
        text = "" if self.kind == "data" else self.value.__doc__
        return inspect.cleandoc(text or "")


def _called(value: Any) -> bool:
    return callable(value) and hasattr(value, "__wrapped__")


def public(package: str) -> list[Public]:
    """The public names of a package, those of the board module by module."""
    module = importlib.import_module(package)
    if not (names := list(_names(module))) and hasattr(module, "__path__"):
        found = (f"{package}.{info.name}" for info in pkgutil.iter_modules(module.__path__))
        return [x for name in found if not name.endswith("__") for x in public(name)]
    members = [Public(f"{package}.{name}", package, getattr(module, name)) for name in names]
    return [x for x in members if not isinstance(x.value, types.ModuleType)]


def _names(module: types.ModuleType) -> Iterator[str]:
    """`__all__`, or else what the package of the module defines and does not hide."""
    if hasattr(module, "__all__"):
        yield from module.__all__
        return
    for name, value in vars(module).items():
        home = getattr(value, "__module__", None) or ""
        own = home == module.__name__ or home.startswith("sorojax_hardware.")
        unit = module.__name__ == "sorojax.units" and isinstance(value, float)
        if not name.startswith("_") and (own or unit):
            yield name


@cache
def everything() -> list[Public]:
    return [name for package in PACKAGES for name in public(package)]


@cache
def reached(package: str) -> list[Public]:
    """Classes that a package defines and does not make public, of arguments and results of
    public names: what `fem.eigenmodes` returns is told too. Private modules are left out."""
    public_ones = {name.value for name in everything() if name.kind == "class"}
    met = {kind for name in everything() for kind in _kinds(name)} - public_ones
    found = [Public(f"{x.__module__}.{x.__qualname__}", package, x) for x in met if x.__doc__]
    mine = [x for x in found if page_of(x.path) == package and "._" not in x.path]
    return sorted(mine, key=lambda x: x.name.lower())


def listed() -> list[Public]:
    """All that the reference tells of."""
    return everything() + [name for package in PACKAGES for name in reached(package)]


def page_of(path: str) -> str:
    """The package that tells of a name: the nearest above it."""
    above = [package for package in PACKAGES if path.startswith(f"{package}.")]
    return max(above, key=len)


def _kinds(name: Public) -> Iterator[type]:
    """Classes of the project in a signature."""
    if name.kind == "data" or not (signature := signature_of(name)):
        return
    kinds = [parameter.annotation for parameter in signature.parameters.values()]
    for kind in [*kinds, signature.return_annotation]:
        yield from _inside(kind)


def _inside(kind: Any) -> Iterator[type]:
    arguments = typing.get_args(kind)
    if inspect.isclass(kind) and not arguments and kind.__module__.startswith("sorojax"):
        yield kind
    for argument in arguments:
        yield from _inside(argument)


def signature_of(name: Public) -> inspect.Signature | None:
    """None for exceptions that take what any exception takes."""
    try:
        return inspect.signature(name.value if name.kind == "class" else name.plain)
    except ValueError:
        return None


def undescribed(name: Public) -> list[str]:
    """What a docstring lacks: all of it, of a noun fields by name, of a verb arguments or what
    comes back."""
    if name.kind == "data":
        return []
    if not name.text:
        return ["docstring"]
    if name.kind == "class":
        told = told_of(name.value)
        return [field for field in fields_of(name.value) if field not in told]
    signature, told = inspect.signature(name.plain), described(name.text)
    lacks = [parameter for parameter in signature.parameters if parameter not in told]
    gives = signature.return_annotation is not None
    return [*lacks, *["Returns"] * (gives and "\nReturns:" not in name.text)]


def fields_of(kind: type) -> list[str]:
    """Public fields of a noun, a data class or a named tuple."""
    data = [field.name for field in fields(kind)] if is_dataclass(kind) else ()
    return [name for name in data or getattr(kind, "_fields", ()) if name[0] != "_"]


def told_of(kind: type) -> set[str]:
    """Names that the docstrings of a class and of its bases in the project describe under
    `Attributes`, or have in backticks: `radius`, `closed=True`."""
    bases = [base for base in kind.__mro__[1:] if base.__module__.startswith("sorojax")]
    texts = [inspect.cleandoc(each.__doc__ or "") for each in (kind, *bases)]
    spans = [span for text in texts for span in re.findall(r"`+([^`]+)`+", text)]
    return {span.partition("=")[0] for span in spans}.union(*map(described, texts))


def described(text: str) -> set[str]:
    """Arguments or fields that a docstring describes; "lower, upper: ..." are two."""
    part = re.search(r"^(?:Args|Attributes):\n((?:    .*\n?|\n)+)", text, re.M)
    heads = re.findall(r"^    ([*\w]+(?:, [*\w]+)*):", part[1] if part else "", re.M)
    return {name.strip(" *") for head in heads for name in head.split(",")}


def main() -> None:
    """Say how many public names there are, and what their docstrings lack."""
    names = everything()
    missing = {name.path: lacks for name in listed() if (lacks := undescribed(name))}
    verbs = sum(name.kind == "function" for name in names)
    print(f"{len(names)} public names, {verbs} of them verbs; {len(missing)} lack something")
    for path, lacks in missing.items():
        print(f"  {path}: {', '.join(lacks)}")


if __name__ == "__main__":
    main()
