"""Signatures on pages of the reference, as `help` has them: arguments and result apart."""

import inspect
from typing import Any

from sorojax._signatures import parameter_texts, type_text


def signature(value: Any, paths: dict[Any, str]) -> tuple[str, str]:
    """Arguments and result of a function or constructor; `paths` has the public classes."""
    plain = inspect.unwrap(value)
    found = inspect.signature(value if inspect.isclass(value) else plain)
    answer = found.return_annotation
    is_told = answer is not found.empty and not inspect.isclass(value)
    texts = parameter_texts(found, paths)
    return f"({', '.join(texts)})", type_text(answer, paths) if is_told else ""
