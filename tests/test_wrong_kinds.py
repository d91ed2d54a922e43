"""Types at the door: every public function and constructor, given each wrong kind of argument
that its signature invites, answers got - need - do before it does anything."""

import dataclasses
import importlib
import inspect
import linecache
import re
import traceback

import equinox as eqx
import numpy as np
import pytest

import sorojax as sj
from sorojax import mesh

FLOORS = sorted(sj._FLOORS)
OBJECT, MESH = object(), mesh.rectangle([0, 0], [1, 1], divisions=(1, 1))

#: Parameters that take any object, and why.
FREE = {
    "any tree of arrays": {
        "design.calibrate": "start lower upper logarithmic",
        "design.minimise": "start",
        "design.minimise_shape": "start",
        "design.propagate_covariance": "numbers deviation",
        "envs.State": "body goal",
        "envs.randomised": "params spread",
        "envs.reset": "params",
        "envs.step": "params",
        "envs.step_with_reset": "params",
        "envs.to_brax": "params",
        "envs.to_gymnasium": "params",
        "envs.to_gymnasium_vector": "params",
        "io.load": "like",
        "io.save": "tree",
        "sweep.sweep": "designs config",
        "systems.outputs": "state",
        "systems.simulate": "state rtol atol",
        "systems.simulate_batch": "designs rtol atol",
        "systems.simulate_sampled": "state memory",
        "systems.body_motion": "state",
        "rod.acceleration": "constants",
        "rod.motion": "constants",
    },
    "each kind of thing is drawn by its own function, which refuses the rest": {
        "robots.model": "robot",
        "view.Surface": "colour",
        "view.actor": "thing",
        "view.animate": "result beside options",
        "view.animate_file": "options",
        "view.live": "options",
        "view.options": "thing",
        "view.rig": "options",
        "view.scene_of": "thing at options",
        "view.scenes_of": "path options",
        "view.show": "thing at options",
        "view.to_glb": "things",
        "view.to_html": "things time",
    },
    "abstract: its subclasses are made, and refuse what is wrong": {
        "envs.AbstractEnv": "time_step substeps max_steps",
    },
    "options of what it calls, or anything with one method": {
        "fem.solve_contact": "options",
        "robots.bench": "options",
        "sweep.dask_local": "options",
        "sweep.sweep": "executor",
        "systems.simulate_sampled": "controller",
        "view.Feed": "process",
        "view.draw_into": "axes",  # matplotlib is not imported for its types
        "vision.MarkerStream": "camera",
    },
}


#: Records: JAX makes them of whatever a map over a tree gives, so they check nothing.
RECORDS = tuple


def verbs():
    """Every public name that takes arguments: path, function or class."""
    for floor in FLOORS:
        package = importlib.import_module(f"sorojax.{floor}")
        for name in dir(package):
            value = getattr(package, name)
            ours = getattr(value, "__module__", "").startswith("sorojax")
            if not name.startswith("_") and ours and callable(value):
                yield f"{floor}.{name}", value


CHECKED = {path: verb for path, verb in verbs() if "__arguments__" in vars(verb)}
IS_FREE = {
    f"{path}.{name}": reason
    for reason, group in FREE.items()
    for path, names in group.items()
    for name in names.split()
}


def test_every_public_verb_checks_its_arguments():
    for path, verb in verbs():
        if path in CHECKED or not isinstance(verb, type):
            assert path in CHECKED, path
            continue
        made_by_verbs = "status" in vars(verb).get("__annotations__", {})
        plain = made_by_verbs or "__init__" not in vars(verb)
        assert issubclass(verb, RECORDS | BaseException | eqx.Enumeration) or plain, path
    assert len(CHECKED) > 600


def invited(parameter, converts):
    """Wrong values by what the annotation says, read as text: not by what is under test."""
    text = str(parameter.annotation) + ("None" if parameter.default is None else "")
    text = re.sub(r"Literal\[.*?\]", "Literal", text.replace("NoneType", "None"))
    known = parameter.annotation is not parameter.empty and "Any" not in text.split("[")[0]
    yield "an object", OBJECT
    if not known or converts or "TypeVar" in text or "~" in text:
        return
    words = ("Numbers", "Float", "Int[", "Bool[", "float", "int", "Array")
    numbers = any(word in text for word in words)
    if "None" not in text:
        yield "None", None
    if not re.search(r"\bstr\b|path|Path|Any|Mapping", text):
        yield "a name", "air"
    if not numbers and not re.search(r"\bbool\b|Any|tuple\[\]", text):
        yield "a number", 2.5
    if "Callable" not in text and "Any" not in text and "type[" not in text:
        yield "a function", len
    if "Mesh" not in text and "Any" not in text and "Module" not in text:
        yield "a mesh", MESH
    if re.fullmatch(r"jaxtyping\.Float\[[^']*'[^.*']*'\]", text):
        yield "an array of another shape", np.zeros((1,) * 5)
    if re.fullmatch(r"jaxtyping\.Int\[[^']*'[^']*'\]", text):
        yield "facets that are no numbers", np.full((3, 2), 0.5)


def given(verb, name, value):
    """`verb` called with one argument only: kinds are checked before all else."""
    parameter = verb.__arguments__.signature.parameters[name]
    if parameter.kind is parameter.VAR_POSITIONAL:
        return verb(value)
    return verb(**{name if parameter.kind is not parameter.VAR_KEYWORD else "extra": value})


def check_refusal(error, where, name):
    """Raised by the framework, in the form got - need - do, of the argument that is wrong."""
    assert type(error) in (TypeError, ValueError)
    frame, line = list(traceback.walk_tb(error.__traceback__))[-1]
    assert frame.f_globals["__name__"].startswith("sorojax.")
    assert linecache.getline(frame.f_code.co_filename, line).strip().startswith("raise ")
    text = str(error)
    assert where in text and f"`{name}`" in text, text
    assert re.search(r": got .*, need .*[.] [A-Z`].*[.]$", text, re.DOTALL), text


def converted(verb):
    """Fields that the constructor converts: their annotation is of the result."""
    if not isinstance(verb, type) or not dataclasses.is_dataclass(verb):
        return set()
    return {field.name for field in dataclasses.fields(verb) if "converter" in field.metadata}


@pytest.mark.stress(62)
@pytest.mark.parametrize("floor", FLOORS)
def test_wrong_kinds_are_refused_by_name(floor):
    missed, count = [], 0
    for path, verb in CHECKED.items():
        if not path.startswith(f"{floor}."):
            continue
        where = verb.__name__ if isinstance(verb, type) else path
        converts = converted(verb)
        for name, parameter in verb.__arguments__.signature.parameters.items():
            if f"{path}.{name}" in IS_FREE or (isinstance(verb, type) and name == "self"):
                continue
            said = "extra" if parameter.kind is parameter.VAR_KEYWORD else name
            for what, value in invited(parameter, name in converts):
                count += 1
                with pytest.raises(Exception) as caught:  # noqa: PT011, which one is asserted
                    given(verb, name, value)
                try:
                    check_refusal(caught.value, where, said)
                except AssertionError:
                    missed.append(f"{path}({name}={what}): {caught.value!r}"[:200])
    assert not missed, "\n".join([f"{len(missed)} of {count}", *missed[:40]])
    assert count > 0


def test_what_is_free_takes_anything():
    """The list of exceptions holds none that is no exception."""
    for place in IS_FREE:
        path, _, name = place.rpartition(".")
        if not inspect.isabstract(CHECKED[path]):
            assert CHECKED[path].__arguments__.kinds[name].accepts(OBJECT), place
