"""The rhythm of legs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_SLOWEST = 8.0  # Hz: below it bodies sway


class Gait(NamedTuple):
    """Of the second half of a record of angles.

    Attributes:
        frequencies: Strongest of every pair [Hz].
        lags: Phase of every pair behind the first [rad], in the two halves of that.
        repeats: Correlation of a period with the one before: 1 if it is the same.
    """

    frequencies: Float[np.ndarray, " pairs"]
    lags: Float[np.ndarray, "2 pairs"]
    repeats: float

    @property
    def drift(self) -> Float[np.ndarray, " pairs"]:
        """Change of the lags from half to half [rad]."""
        return (self.lags[1] - self.lags[0] + np.pi) % (2 * np.pi) - np.pi


def gait(times: Float[np.ndarray, " times"], angles: Float[np.ndarray, "times pairs"]) -> Gait:
    """Rhythm of legs from their angles [rad] at evenly spaced `times` [s].

    Raises:
        ValueError: If half the record is shorter than 0.15 s.
    """
    times, angles = np.asarray(times), np.asarray(angles)
    late = len(times) // 2
    t, waves = times[late:], angles[late:] - angles[late:].mean(axis=0)
    if not t[-1] - t[0] > 1.2 / _SLOWEST:
        raise ValueError(
            f"gait: half the record is {t[-1] - t[0]:.3g} s, need {1.2 / _SLOWEST:.3g} s. "
            "Simulate longer."
        )
    step, size = times[1] - times[0], 32 * len(t)
    power = np.abs(np.fft.rfft(waves * np.hanning(len(t))[:, None], size, axis=0))
    at = np.fft.rfftfreq(size, step)
    power[at < _SLOWEST] = 0
    found = at[power.argmax(axis=0)]
    period = round(1 / found[0] / step)
    count = max(1, len(t) // 2 // period) * period
    turned = waves * np.exp(-2j * np.pi * found[0] * t)[:, None]
    phases = np.stack([part.sum(axis=0) for part in (turned[:count], turned[-count:])])
    before, after = waves[:-period], waves[period:]
    same = (before * after).sum() / np.sqrt((before**2).sum() * (after**2).sum())
    return Gait(found, np.angle(phases[:, :1] / phases), float(same))
