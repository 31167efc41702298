"""What the reader of a record should know first: what is not scored, a leg cut short, estimators not to be trusted.

An estimator is not to be trusted that faults led astray, or that is surer than its innovations allow.

The normalised innovation squared of n samples with m components each is, summed, chi-square with n m degrees of freedom
if the filter's model is right (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation,
2001, 5.4). No model of ours is exactly right, and in 10 000 samples one hundredth too much would show: what is told is
beyond `FAR` too. Below 1 nothing is told: who expects more noise than there is, gusts above all, loses accuracy and
misleads nobody.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri  # as scipy.stats, which takes half a second to import

from testbed.score import accuracy, detection
from testbed.score import metrics as scores
from testbed.score.plan import unfinished_leg

if TYPE_CHECKING:
    import xarray

CONFIDENCE = 0.999  # of the bound
FAR = 1.5  # mean NIS per degree of freedom: sigmas are a fifth too small


def remarks(dataset: xarray.DataTree, metrics: Mapping[str, float]) -> list[str]:
    """A sentence for each thing that the reader of a record should know first; ``metrics`` are its own."""
    return [
        *scores.unscored(dataset),
        *unfinished_leg(dataset),
        *_astray(dataset, metrics),
        *_overconfident(dataset, metrics),
    ]


def _astray(dataset: xarray.DataTree, metrics: Mapping[str, float]) -> Iterator[str]:
    faults = detection.faults(dataset)
    for name in accuracy.names(dataset):
        during = [one for one in faults if metrics.get(f"{name}.error_over_3sigma.{one.name}", 0.0) > 1.0]
        if not during:
            continue
        e = accuracy.errors(dataset, name)
        rows = np.flatnonzero(e.valid & accuracy.inside(e.t, [detection.fault_window(one) for one in during]))
        worst = rows[np.nanargmax(e.over_3sigma[rows])]
        error = e.horizontal[worst]
        yield (
            f"{name} was led astray and doesn't know it: with {', '.join(one.name for one in during)} its position was "
            f"{error:.3g} m wrong at {e.t[worst]:.0f} s, where it claims {error / e.over_3sigma[worst]:.3g} m (3 σ)"
        )


def _overconfident(dataset: xarray.DataTree, metrics: Mapping[str, float]) -> Iterator[str]:
    """From `SETTLING_S` after alignment on, but not while a fault lasts, nor `RECOVERY_WINDOW_S` after it."""
    faulty = [detection.fault_window(one) for one in detection.faults(dataset)]
    for name in accuracy.names(dataset):
        start = metrics.get(f"{name}.aligned_s", np.inf) + accuracy.SETTLING_S
        for aid in accuracy.aids(dataset, name):
            looks = detection.judged(dataset, name, aid)
            nis = looks.nis[(looks.t >= start) & ~accuracy.inside(looks.t, faulty)]
            degrees = len(nis) * looks.components
            if not degrees:
                continue
            mean, bound = float(nis.sum()) / degrees, float(chdtri(degrees, 1.0 - CONFIDENCE)) / degrees
            if mean > max(FAR, bound):
                yield (
                    f"{name} is too sure of {aid}: the mean NIS is {mean:.3g} per degree of freedom, where up to "
                    f"{bound:.3g} would fit; its noise is larger, or the model worse, than the filter is told"
                )
