"""What is claimed of a sensor's errors, following what its innovations say.

Noise that a data sheet tells for all flights is too wide for the quiet ones and too narrow for some manoeuvres. Of a
filter whose S is right the mean of nu' S^-1 nu / m is one (Mehra, Approaches to adaptive filtering, IEEE Trans.
Automatic Control 17 (5), 1972; Mohamed and Schwarz, Adaptive Kalman filtering for INS/GPS, J. Geodesy 73 (4), 1999). So
a claim is multiplied by a scale s that seeks it, with dt from one sample to the next and a time constant T:

    s <- s exp(dt / T (min(nu' S^-1 nu / m, `OUTLYING`) - 1)),    within ``least`` and ``most``

What the gate refuses teaches as well: else a claim that is too narrow would refuse what could widen it. A filter that
begins anew, or that has not heard of the sensor for `PAUSE_S`, claims what is told. Innovations that are alike for
seconds, as a receiver's are, would make any white noise as small as they let it; hence the limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

NARROWEST, WIDEST = 1 / 9, 9.0  # of a variance that is told: a third and three times of the sigma
OUTLYING = 10.0  # times what is expected that an innovation counts at most
LONGEST_S, PAUSE_S = 1.0, 10.0  # between two samples: that count at most, and after which all is as told


class Following(NamedTuple):
    """How a claim follows: its time constant and limits; the Markov error that it is on, by its state, and as told.

    Of that it is the driving noise that is scaled; without one, the variances of the measurement.
    """

    time_s: float
    least: float = NARROWEST
    most: float = 1.0
    state: str = ""
    sigma: float = 0.0


@runtime_checkable
class FollowingAid(Protocol):
    """An aid some of whose claims follow innovations, part by part."""

    @property
    def following(self) -> Mapping[str, Following]:
        """How, by the names of the parts; empty where all are as told."""
        ...


@dataclass
class Claim:
    """The scale of one claim; see above."""

    following: Following
    scale: float = 1.0
    _heard: float = math.nan  # when the latest sample was [s]

    def at(self, t: float) -> float:
        """The scale that counts for a sample at ``t`` [s]."""
        return 1.0 if t - self._heard > PAUSE_S else self.scale

    def begin(self) -> None:
        """Forget everything."""
        self.scale, self._heard = 1.0, math.nan

    def heard(self, ratio: float, t: float) -> None:
        """A sample at ``t`` [s] had nu' S^-1 nu / m = ``ratio``; one that it was told of before changes nothing."""
        since = t - self._heard if math.isfinite(self._heard) else 0.0
        if since < 0.0 or not math.isfinite(ratio):
            return
        before, self._heard = self.at(t), t
        _, least, most, *_ = self.following
        step = min(since, LONGEST_S) / self.following.time_s * (min(ratio, OUTLYING) - 1.0)
        self.scale = min(max(before * math.exp(min(step, math.log(most / least))), least), most)
