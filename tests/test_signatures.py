"""Signatures of public functions and constructors: short to read, with all that tools need."""

import inspect
import pickle
import pydoc

import jax
import jax.numpy as jnp
import pytest

import sorojax as sj
from sorojax import design, fem, material, mesh, reduction, robots, rod, sdf, systems
from sorojax._signatures import Signature

PACKAGES = (design, fem, material, mesh, reduction, robots, rod, sdf, systems)


def public(package):
    values = (getattr(package, name) for name in package.__all__)
    return [value for value in values if hasattr(value, "__arguments__")]


def test_help_is_read_at_a_glance():
    text = pydoc.plain(pydoc.render_doc(sj.fem.solve))
    told = " ".join(text.partition("\n\n")[2].partition("Static equilibrium")[0].split())
    told = told.replace("( ", "(").replace(" )", ")")  # from Python 3.13 on over many lines
    assert told == (
        "solve(problem: fem.Problem, *, start: Float[nodes, dim] | None = None, "
        "newton: fem.Newton | None = None, steps: int = 1, max_cuts: int = 10, "
        "throw: bool = True) -> fem.Solution"
    )


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_signatures_are_short(package):
    """No module paths of arrays, no unions of what becomes an array, no defaults by address."""
    assert public(package)
    for value in public(package):
        found = inspect.signature(value)
        texts = list(map(str, found.parameters.values()))
        whole = f"{value.__name__}{found} {' '.join(texts)}"
        assert not any(part in whole for part in ("jaxlib", "collections.abc", "<", " at 0x"))
        assert max(map(len, texts), default=0) < 200, whole


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_annotations_and_defaults_stay(package):
    """What checks and tools read is what the function was written with."""
    for value in public(package):
        is_class = inspect.isclass(value)
        own = inspect.signature(inspect.unwrap(vars(value)["__init__"] if is_class else value))
        written = list(own.parameters.values())[1 if is_class else 0 :]
        found = inspect.signature(value)
        assert list(found.parameters) == [parameter.name for parameter in written]
        for parameter in written:
            other = found.parameters[parameter.name]
            assert other.annotation is parameter.annotation, (value, parameter)
            assert other.default is parameter.default and other.kind == parameter.kind
        assert found.return_annotation == own.return_annotation


def test_a_signature_is_read_when_it_is_asked_for():
    reads = []

    class Asked:
        @property
        def __signature__(self):
            reads.append(1)
            return inspect.signature(lambda x, /, y: x)

        def __call__(self):
            return None

    found = Signature(function=Asked())
    assert not reads
    assert str(found) == "(x, /, y)" and list(found.parameters) == ["x", "y"] and reads == [1]


def test_a_signature_binds_changes_and_travels():
    found = inspect.signature(sj.fem.solve)
    bound = found.bind("problem", steps=3)
    assert bound.arguments == {"problem": "problem", "steps": 3}
    shorter = found.replace(parameters=list(found.parameters.values())[:1])
    assert str(shorter) == "(problem: fem.Problem) -> fem.Solution"
    plain = inspect.signature(inspect.unwrap(sj.fem.solve))
    assert found == plain and hash(found) == hash(plain)
    again = pickle.loads(pickle.dumps(inspect.signature(sj.rod.circle)))
    assert str(again) == str(inspect.signature(sj.rod.circle))


def test_long_signatures_have_a_line_for_each_parameter():
    def long(first, *rest, by: "int" = 1, **options):
        return first, rest, by, options

    found = Signature(function=long)
    assert found.format() == "(first, *rest, by: int = 1, **options)"
    lines = found.format(max_width=20).splitlines()
    assert lines == ["(", "    first,", "    *rest,", "    by: int = 1,", "    **options", ")"]


def test_shapes_are_checked_as_before():
    finger = rod.rod(
        sj.SE3(), rod.chebyshev(kappa_y=2), rod.circle(5e-3), length=0.1, young_modulus=1e6,
        poisson_ratio=0.3, density=1000.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"shape \(3,\), need \(2\)"):
        rod.mass_matrix(finger, jnp.zeros(3))
    with pytest.raises(TypeError, match="circle"):
        rod.circle("thick")  # type: ignore[arg-type]
    named = jax.jit(rod.mass_matrix, static_argnames=())(finger, jnp.zeros(2))
    assert named.shape == (2, 2)
