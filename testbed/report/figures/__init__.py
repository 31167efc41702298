"""All figures of a run, in reading order: the one list of them."""

from __future__ import annotations

from testbed.report.figures import consistency, errors, flight, imu, observability
from testbed.report.figures.plot import Chapter

CHAPTERS = (
    Chapter("All estimators", (*flight.PLOTS, *errors.OF_ALL, *consistency.OF_ALL)),
    Chapter("{}", (*errors.OF_EACH, *imu.OF_ESTIMATOR, *consistency.OF_EACH), lambda run: run.aligned),
    Chapter("Unit {}", imu.OF_UNIT, lambda run: run.imus),
    Chapter("Observability", observability.PLOTS),
)
