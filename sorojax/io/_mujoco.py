"""MuJoCo, which reads robots and checks what is written for it; imported where it is used."""

from typing import Any


def parser(where: str) -> Any:
    """The package `mujoco`, or an error that says how to get it."""
    try:
        import mujoco
    except ImportError as reason:
        raise ModuleNotFoundError(
            f"{where}: mujoco cannot be imported ({reason}), need it as the parser. Install "
            "it with `pip install 'sorojax[robots]'`."
        ) from reason
    return mujoco
