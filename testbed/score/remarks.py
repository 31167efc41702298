"""What the reader of a record should know first: what is not scored, a leg cut short, estimators not to be trusted.

An estimator is not to be trusted that faults led astray, or that is surer than its innovations allow. One that claims
variances that there can't be is judged by its errors alone where it does, and that is said: NEES would just be missing.

The normalised innovation squared of n samples with m components each is, summed, chi-square with n m degrees of freedom
if the filter's model is right (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation,
2001, 5.4). No model of ours is exactly right, and in 10 000 samples one hundredth too much would show: what is told is
beyond `FAR` too. A single sample that is wildly wrong, which a gate refuses, says nothing of the filter: each counts as
no more than one in a thousand should have. Those refused count, or who refuses most would seem sound. Below 1 nothing
is told: who expects more noise than there is, gusts above all, loses accuracy and misleads nobody.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nav.detection import chi_square_threshold
from nav.samples import Outcome, Status
from testbed.errors import UserError
from testbed.record.reader import scenario_of
from testbed.score import accuracy, detection
from testbed.score import metrics as scores
from testbed.score.plan import not_as_planned

if TYPE_CHECKING:
    import xarray

VARIANCES = tuple(f"{axis} {what}" for what in ("position", "velocity", "attitude") for axis in accuracy.AXES)
LOST = ".nonfinite_samples"
ESTIMATED = {"position": ("lat", "lon", "h"), "velocity": ("v_n",), "attitude": ("q_nb",)}  # each in three rows of P
CONFIDENCE = 0.999  # of the bound
WORSE = 2.0  # times the largest error over claimed sigma before a fault: that is its doing
FEW, MOST = 10, 0.5  # looks, and the share of them that nobody refuses who is right
USELESS = Outcome.OUT_OF_RANGE, Outcome.UNSOUND
FAR = 1.5  # mean NIS per degree of freedom: sigmas are a fifth too small


def remarks(dataset: xarray.DataTree, metrics: Mapping[str, float]) -> list[str]:
    """A sentence for each thing that the reader of a record should know first; ``metrics`` are its own."""
    astray = dict(_astray(dataset, metrics))
    trusted = [name for name in accuracy.names(dataset) if name not in astray]
    reference = dataset.attrs.get("reference")
    return [
        *([f"errors are against {reference}"] if reference else []),
        *scores.unscored(dataset),
        *not_finite(metrics),
        *_silent(dataset),
        *_refusing(dataset),
        *_useless(dataset),
        *_uncounted(dataset),
        *not_as_planned(dataset),
        *_impossible(dataset),
        *_unjudged(dataset),
        *astray.values(),
        *_overconfident(dataset, metrics, trusted),
    ]


def not_finite(metrics: Mapping[str, float]) -> list[str]:
    """Who, once aligned, gave estimates that are no numbers, and so are in no other metric: a sentence each."""
    lost = {key.removesuffix(LOST): count for key, count in metrics.items() if key.endswith(LOST)}
    return [f"{name}: {n:.0f} estimates since its alignment are not finite, and not scored" for name, n in lost.items()]


def _silent(dataset: xarray.DataTree) -> list[str]:
    """Which sensors of the scenario gave nothing at all, such as one that never saw the ground."""
    try:
        scenario = scenario_of(dataset)
    except UserError:  # `unscored` says so
        return []
    heard = dataset["sensors"].children if "sensors" in dataset.children else ()
    kept = [name for name, config in scenario.sensors.items() if scenario.record.imu or config.kind != "imu"]
    return [f"{name}: gave no sample in the whole run" for name in kept if name not in heard]


def _refusing(dataset: xarray.DataTree) -> Iterator[str]:
    """Who refuses most of what it is aided by, in a run that is too short to be scored."""
    for name in accuracy.names(dataset):
        t, aligned_s = accuracy.alignment(dataset, name)
        if aligned_s is None or t[-1] >= aligned_s + accuracy.SETTLING_S:
            continue
        for aid in accuracy.aids(dataset, name):
            looks = detection.judged(dataset, name, aid)
            gated = looks.gated[looks.t >= aligned_s]
            if len(gated) >= FEW and gated.mean() > MOST:
                yield f"{name} refused {gated.mean():.0%} of {aid} since its alignment: it is wrong, or the sensor is"


def _useless(dataset: xarray.DataTree) -> Iterator[str]:
    """Which aids are of no use to an estimator, as one in a wrong unit: no statistic of innovations tells of that."""
    for name in accuracy.names(dataset):
        _, aligned_s = accuracy.alignment(dataset, name)
        for aid in accuracy.aids(dataset, name) if aligned_s is not None else ():
            t, outcome, reason = (
                accuracy.column(dataset, f"estimators/{name}/innovations/{aid}/{what}")
                for what in ("sample_time", "outcome", "reason")
            )
            since = t >= aligned_s
            if since.sum() >= FEW and np.isin(outcome[since], USELESS).all():
                ((why, _),) = Counter(reason[since].tolist()).most_common(1)
                yield f"{name} could use none of {since.sum()} samples of {aid} since its alignment, such as: {why}"


def _uncounted(dataset: xarray.DataTree) -> Iterator[str]:
    """What faults did to whom before errors count, in a run that is scored: no metric of errors tells of it."""
    faults = detection.faults(dataset)
    for name in accuracy.names(dataset) if faults else ():
        t, aligned_s = accuracy.alignment(dataset, name)
        if aligned_s is None or t[-1] < aligned_s + accuracy.SETTLING_S:  # `unscored` says so
            continue
        counting, taken = aligned_s + accuracy.SETTLING_S, detection.taken(dataset, name)
        for one in faults:
            if one.start < counting - accuracy.SAME_TIME_S and one.sensor in taken:
                how = "counted in part" if detection.fault_window(one)[1] > counting else "not counted"
                yield (
                    f"{name}: its errors with {one.name}, from {one.start:g} to {one.end:g} s, are {how}: errors count "
                    f"from {counting:.1f} s, {accuracy.SETTLING_S:g} s after its alignment"
                )


def _impossible(dataset: xarray.DataTree) -> Iterator[str]:
    """Who claims to be sure beyond all doubt, or surer; NaN claims nothing."""
    for name in accuracy.names(dataset):
        own = f"estimators/{name}"
        status, covariance = (accuracy.column(dataset, f"{own}/{what}") for what in ("status", "covariance"))
        aligned = (status & Status.ALIGNED) != 0
        known = np.arange(len(VARIANCES)) >= np.where(status & Status.ATTITUDE_ONLY, 6, 0)[:, None]
        wrong = (np.diagonal(covariance, axis1=1, axis2=2) <= 0) & known & aligned[:, None]
        rows = wrong.any(axis=1)
        if rows.any():
            which = ", ".join(VARIANCES[k] for k in np.flatnonzero(wrong.any(axis=0)))
            yield (
                f"{name} claims a variance of 0 or below in {rows.sum()} of {aligned.sum()} estimates ({which}): no "
                f"NEES and no 3 σ there"
            )


def _unjudged(dataset: xarray.DataTree) -> Iterator[str]:
    """Whose covariances give no NEES though all their variances are positive, or end before the estimates do."""
    for name in accuracy.names(dataset):
        own = f"estimators/{name}"
        status, covariance = (accuracy.column(dataset, f"{own}/{what}") for what in ("status", "covariance"))
        aligned = (status & Status.ALIGNED) != 0
        positive = (np.diagonal(covariance, axis1=1, axis2=2) > 0) & aligned[:, None]
        for k, what in enumerate(ESTIMATED):
            block = slice(3 * k, 3 * k + 3)
            known = positive[:, block].all(axis=1)
            unformed = np.isnan(accuracy.nees(np.zeros((len(known), 3)), covariance[:, block, block])) & known
            if unformed.any():
                yield (
                    f"{name} claims a covariance of {what} that is not positive definite in {unformed.sum()} of "
                    f"{aligned.sum()} estimates: no NEES there"
                )
            said = np.column_stack([accuracy.column(dataset, f"{own}/{one}") for one in ESTIMATED[what]])
            told = np.isfinite(said).all(axis=1) & aligned
            silent = told & ~np.isfinite(covariance[:, block, block]).all(axis=(1, 2))
            if silent.any() and (told & ~silent).any():
                yield (
                    f"{name} claims no covariance of {what} in {silent.sum()} of {aligned.sum()} estimates: no NEES "
                    f"and no 3 σ there"
                )


def _astray(dataset: xarray.DataTree, metrics: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    """Who was led astray, and the sentence: by the faults about the worst moment, if it was never half as bad before.

    What an estimator claimed too much all the time is not a fault's doing.
    """
    faults = detection.faults(dataset)
    for name in accuracy.names(dataset):
        during = [one for one in faults if metrics.get(f"{name}.error_over_3sigma.{one.name}", 0.0) > 1.0]
        if not during:
            continue
        e = accuracy.errors(dataset, name)
        known = e.valid & np.isfinite(e.over_3sigma)
        rows = np.flatnonzero(known & accuracy.inside(e.t, [detection.fault_window(one) for one in during]))
        if not len(rows):
            continue
        worst = rows[np.argmax(e.over_3sigma[rows])]
        before = known & (e.t < min(one.start for one in during))
        if WORSE * e.over_3sigma[before].max(initial=0.0) >= e.over_3sigma[worst]:
            continue
        t, error = e.t[worst], e.horizontal[worst]
        about = ", ".join(one.name for one in during if accuracy.inside(e.t, [detection.fault_window(one)])[worst])
        yield (
            name,
            f"{name} was led astray and doesn't know it: with {about} its position was {error:.3g} m wrong at {t:.0f} "
            f"s, where it claims {error / e.over_3sigma[worst]:.3g} m (3 σ)",
        )


def _overconfident(dataset: xarray.DataTree, metrics: Mapping[str, float], names: Sequence[str]) -> Iterator[str]:
    """From `SETTLING_S` after alignment on, but not while a fault lasts, nor `RECOVERY_WINDOW_S` after it."""
    faulty = [detection.fault_window(one) for one in detection.faults(dataset)]
    for name in names:
        start = metrics.get(f"{name}.aligned_s", np.inf) + accuracy.SETTLING_S
        for aid in accuracy.aids(dataset, name):
            looks = detection.judged(dataset, name, aid)
            nis = looks.nis[(looks.t >= start) & ~accuracy.inside(looks.t, faulty)]
            degrees = len(nis) * looks.components
            if not degrees:
                continue
            most = chi_square_threshold(1.0 - CONFIDENCE, looks.components)
            mean = float(np.minimum(nis, most).sum()) / degrees
            bound = chi_square_threshold(1.0 - CONFIDENCE, degrees) / degrees
            if mean > max(FAR, bound):
                yield (
                    f"{name} is too sure of {aid}: the mean NIS is {mean:.3g} per degree of freedom, none counted for "
                    f"more than {most / looks.components:.3g}, where up to {bound:.3g} would fit; its noise is larger, "
                    f"or the model worse, than the filter is told"
                )
