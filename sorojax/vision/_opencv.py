"""OpenCV, loaded where an image is looked at."""

import functools
from typing import Any


@functools.cache
def opencv() -> Any:
    """The module `cv2`.

    Raises:
        ImportError: If it is not installed.
    """
    try:
        import cv2
    except ImportError as missing:
        raise ImportError(
            "sorojax.vision: need OpenCV. pip install 'sorojax[vision]'"
        ) from missing
    return cv2
