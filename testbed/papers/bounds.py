"""What no detector could better: the test that is told when a fault begins and what it adds (Neyman and Pearson).

With a probability of false alarm p it finds a fault with probability Phi(d - z), where d^2 is the sum of the squares of
what the fault has added to residuals of unit sigma by then, and z the quantile of 1 - p. At one sample p is that of a
sample; an alarm at any of n samples without a fault has n times that at most: the p of a first alarm within n samples.
"""

from __future__ import annotations

import math

import numpy as np

from nav.samples import Array

TOLD = "the test that is told when the fault begins and how it grows has"


def told_test(added: Array, false_alarm: float) -> tuple[float, float]:
    """(samples before the median first alarm, infinite when there is none; mean over the samples of its probability).

    ``added`` (n,) is the fault in sigma at each sample from its beginning on, ``false_alarm`` the probability of one at
    each sample.
    """
    from scipy.stats import norm

    d = np.sqrt(np.cumsum(added**2))
    within = np.minimum(false_alarm * np.arange(1, len(added) + 1), 0.5)
    found = np.flatnonzero(norm.cdf(d - norm.isf(within)) >= 0.5)
    first = float(found[0]) if len(found) else math.inf
    return first, float(norm.cdf(d - norm.isf(false_alarm)).mean())
