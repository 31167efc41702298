"""The options of a federated filter (`Config`), and when to choose which; `nav.federated` is the estimator.

Sharing
    The common process noise and initial covariance reach every filter, which correlates their errors. With shares
    beta_i that add up to one, filter i is given Q / beta_i and P0 / beta_i: then the sum of their information claims no
    more than there is, whatever the correlation (Cui et al. 2022, Eq 7; needed without resets too).

Structure
    ``no_reset``: the filters stay independent. ``full_reset``: after each fusion x_i = x_g, P_i = P_g / beta_i.
    ``partial``: P_i^-1 <- (1 - alpha) P_i^-1 + alpha beta_i P_g^-1, and x_i likewise, alpha being the retention. What a
    filter knows of its own aids given the common states is kept through any reset (`nav.fusion.reset`).

Faults
    Each part of a sensor's samples has a monitor (`nav.monitor.Monitor`): its detector judges the innovation against
    the local filter; axes that it refuses are left out, and isolated when that lasts (`nav.monitor.Patience`). A sensor
    with one part isolated on every axis is isolated as a whole. While any part of a sensor is isolated, it is judged
    against the fused solution of the filters without an isolated part, since its own filter drifts, or is wrong.

    A fault that grows slowly has pulled its filter before it is found. Therefore, on every isolation, all filters start
    again from the fused solution of those without an isolated part, P_i = P_g / beta_i: nothing of the faulty sensor
    stays in any of them, nothing is counted twice, and the Markov errors of its aid go back to their first variance.
    Filters with an isolated part get next to no share of the information, as it is lost when another part is isolated.
    When all filters have an isolated part, they are left as they are. So they are where the sensor was far off at once
    (`Monitor.sudden`) and the position is known by its filter alone, which nobody contradicts: nothing of the fault was
    used, and all would be lost with it (`nav.master.MasterFilter.rests_on`). It is then judged by all of them.

    When every position was refused for ``patience_s``, the filters' covariances were too small: their positions and
    velocities are given up as in `nav.ins`, and the next fixes are believed. So they are, as there, after 4 s of fixes
    that agree with each other where the wind speaks for them (`nav.doubts`).

Which structure finds faults
    With ``no_reset`` a fault stays in its own filter until it is found, but a filter that is alone with a poor IMU
    follows a spoofer whose velocity grows slowly together with its position, and never notices: that takes a
    cross-check. With ``full_reset`` the fault reaches all filters until it is found, but every measurement is judged by
    what all sensors predict, and the sound receiver keeps that prediction with the IMU. Without aid in an outage
    ``full_reset`` is as good as one filter with every sensor; without resets nobody combines one filter's wind with
    another's heading.

Cross-check
    A fault that grows as smoothly as the aircraft could move drags its own filter along and is never seen there; but
    then the filters contradict each other. With ``cross_check``, before a fusion each filter without an isolated part
    is compared with the fused solution of the others in position and velocity, which sharing has made independent:
    (x_i - x_o)' (P_i + P_o)^-1 (x_i - x_o) is chi-square of six degrees of freedom at most. When the largest exceeds
    its limit, one filter is wrong. Among the filters that contradict the others about as strongly, the sensor whose
    detector has had the most evidence of late (`Monitor.suspected`) is isolated. A sound sensor's has little; a faulty
    one's has more if it remembers the onset, as `nav.detection.Glr` does. With resets all filters agree and nothing can
    be compared, so a cross-check needs ``no_reset``. With two receivers and no third filter to decide between them, a
    fault that is too slow for any detector is found, but may be laid on the wrong receiver.

Weighting
    ``normalised`` weakens a measurement before its detector refuses it: its variances become R / N with the weight of
    `nav.weighting.normalised_weights` (Zhou et al. 2025, Eq 22-26) from its own statistic and that of every other
    filter, each filter counting by the most suspect of its latest measurements. A filter without one in the last
    seconds is not counted.

    A policy that learns R (`nav.weighting.SageHusa`) is asked before the detector, which judges by the learned R.
    Nothing is learned from samples that are refused or isolated: a sensor that is far noisier than it says may be
    isolated before its R is known, and then stays isolated like a faulty one. A detector that keeps the sound axes, or
    gathers evidence, leaves time to learn.

Engines
    A filter with a `Local.scaling` works by sigma points around its own estimate, which is the nominal state with x
    added to it and may be tens of degrees away. The attitude's part of x is therefore a rotation vector, which is
    composed with the nominal attitude instead of added. P is the covariance of the error of the filter's own estimate;
    for the fusion it is turned into that of x, and back after a reset (`nav.reference.turned`). A federation of one
    such filter gives what the closed filter of `nav.ins` gives, however seldom it fuses. Where the initial heading may
    be far off, let every filter that can observe the heading work by sigma points: a linear one may be wrong about it
    and claim a small sigma, and the fusion would follow.

Recall
    Starting again from the others is costly when they don't know what the isolated filter knew. With ``recall_s``, and
    without resets, each filter has two shadows, carried along without measurements and renewed in turn every
    ``recall_s`` (two shadow filters: Da, J. Guidance 17, 1994). An isolation then puts this one filter back to its
    older shadow, ``recall_s`` to twice that old, and leaves the others. What was measured before the shadow was taken
    stays, so the fault must be found sooner. The isolated sensor is judged against the fused solution of all filters,
    which are sound then.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from nav.aids.base import Aid
from nav.error_model import ImuModel
from nav.fusion import Combination, Weigh, weights_by_covariance
from nav.monitor import MonitoredAid, Patience
from nav.samples import Array
from nav.unscented import Scaling
from nav.weighting import Normalise, normalised_weights

Structure = Literal["no_reset", "full_reset", "partial"]
Sharing = Literal["fixed", "by_covariance", "none"]
Weighting = Literal["none", "normalised"]


@dataclass(frozen=True)
class Local:
    """One local filter: its sensors; ``share`` of the information, all alike when no filter has one.

    With a ``scaling`` it works by sigma points instead of derivatives.
    """

    name: str
    sensors: tuple[MonitoredAid, ...]
    share: float | None = None
    scaling: Scaling | None = None


@dataclass(frozen=True)
class Config:
    """What the federation is told.

    ``weigh`` gives the weights of a combination other than ``information``, and ``normalise`` those of the
    ``normalised`` weighting: functions of another rule may be handed over.
    """

    imu: ImuModel
    locals: tuple[Local, ...]
    structure: Structure = "no_reset"
    sharing: Sharing = "fixed"
    combination: Combination = "information"
    retention: float = 0.5  # alpha of ``partial``: 0 is no reset, 1 a full one
    weighting: Weighting = "none"
    weigh: Weigh = weights_by_covariance
    normalise: Normalise = normalised_weights
    fusion_period_s: float = 1.0  # at the first aiding epoch after this; 0 is at every one
    patience: Patience = field(default_factory=Patience)
    recall_s: float | None = None  # age of what an isolated filter goes back to; None: to the others' solution
    cross_check: bool = False  # of the filters' solutions, at every fusion
    patience_s: float = 30.0  # of refused positions and none fused
    covariance_period: int = 10  # IMU samples per covariance step
    mounting_sigma: float = 0.0  # between the axes of the IMU and of the body [rad]
    alignment_s: float = 2.0
    alignment_aids: tuple[Aid, ...] = ()  # sensors that serve the alignment only

    def __post_init__(self) -> None:
        names = [local.name for local in self.locals]
        if not names or len(set(names)) < len(names):
            raise ValueError("a federation needs local filters, each with a name of its own")
        given = [local.share for local in self.locals if local.share is not None]
        if given and (len(given) < len(names) or min(given) <= 0 or abs(sum(given) - 1) > 1e-6):
            raise ValueError("give every local filter a positive share so that they add up to 1, or none of them")
        if not 0 <= self.retention <= 1:
            raise ValueError(f"retention {self.retention} is no fraction from 0 to 1")
        if self.recall_s is not None and self.structure != "no_reset":
            raise ValueError(f"structure {self.structure!r} spreads what recall_s would take back from one filter")
        if self.cross_check and (self.structure != "no_reset" or self.combination != "information"):
            raise ValueError("cross_check compares independent filters: structure no_reset and information needed")
        if self.combination == "information":
            if self.sharing == "none" and self.structure != "no_reset":
                raise ValueError(f"structure {self.structure!r} counts information again and again without sharing it")
        elif self.sharing != "none":
            raise ValueError(f"combination {self.combination!r} allows for correlation itself: sharing must be 'none'")
        if not (self.imu.gyro_bias_sigma > 0 and self.imu.accel_bias_sigma > 0):
            raise ValueError("the biases of the IMU need a sigma above zero")

    @property
    def shares(self) -> Array:
        """Fixed share of each local filter, adding up to one."""
        n = len(self.locals)
        return np.array([1 / n if local.share is None else local.share for local in self.locals])
