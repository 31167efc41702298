"""Inertial units: what they measured beyond truth, how noisy they are, and what estimators think of their biases."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from nav import earth
from nav.samples import Array
from testbed.report.figures.plot import Plot
from testbed.report.run import Run
from testbed.report.style import FAINT, NEUTRAL, PROMISED, TRUTH, keys_of, logarithmic, sheet, stride, tints
from testbed.score.accuracy import column
from testbed.sensors.imu import ImuErrors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BIAS_MEAN_S = 60.0
BIAS_STEP_S = 10.0
BROKEN = 1e3  # an increment [rad], [m/s] that no IMU measured
AXES = ("forward", "right", "down")
DEGPH, MG = np.rad2deg(3600.0), 1000 / earth.STANDARD_GRAVITY

AT_REST_MPS = 1e-3  # true speed of a body at rest,
AT_REST_RADPS = 1e-4  # and its true rate: the Earth's is 7e-5 rad/s
REST_S = 60.0  # the shortest rest that an Allan deviation says something of
TAUS_PER_DECADE = 8
LONGEST_SHARE = 9  # averaging times up to this part of the record: with fewer stretches the deviation is chance
SPECTRUM_S = 20.0  # length of a stretch: lines of 0.05 Hz


def biases(run: Run, name: str) -> Figure | None:
    """Estimated biases with ±3 sigma, over what the IMU's error really was where the record tells."""
    units = {"gyro": ("gyro bias", DEGPH, "deg/h"), "accel": ("accelerometer bias", MG, "mg")}
    own = {what: run.estimate(name, f"sigma_{what}_bias") for what in units}
    own = {what: sigma for what, sigma in own.items() if np.nanmax(sigma, initial=0.0) > 0}  # the states that it has
    if not own:
        return None
    drawn = sheet(3, len(own))
    real = imu_error(run, name)
    t = run.estimate(name, "time")
    some = stride(len(t))
    for axes, (what, sigmas) in zip(drawn.axes.T, own.items(), strict=True):
        title, scale, unit = units[what]
        value, sigma = scale * run.estimate(name, f"{what}_bias"), scale * sigmas
        for k, ax in enumerate(axes):
            low, high = value[some, k] - 3 * sigma[some, k], value[some, k] + 3 * sigma[some, k]
            ax.fill_between(t[some], low, high, color=run.colours[name], alpha=FAINT, lw=0, label="±3 sigma, claimed")
            true = scale * real[what][:, k] if real is not None else value[:0, k]
            if real is not None:
                ax.plot(real["t"], true, color=TRUTH, lw=1, label="IMU - truth, mean of 60 s")
            ax.plot(t[some], value[some, k], color=run.colours[name], lw=1.3, label="estimate")
            ax.set_ylabel(f"{AXES[k]} [{unit}]")
            _focus_bias(ax, value[:, k], true)
        axes[0].set_title(title, y=1.0, fontsize=10, loc="left")
    run.against_time(drawn, 0.25)
    return drawn.figure


def _focus_bias(ax: Axes, value: Array, real: Array) -> None:
    """Limits around what matters: the first guess's wide bound is cut off."""
    both = np.concatenate([value[np.isfinite(value)], real[np.isfinite(real)]])
    if len(both):
        low, high = float(both.min()), float(both.max())
        margin = 0.6 * (high - low) + 1e-9
        ax.set_ylim(low - margin, high + margin)


def imu_error(run: Run, estimator: str) -> dict[str, Array] | None:
    """Times ``t`` (N,) and mean error ``gyro`` (N, 3) [rad/s], ``accel`` (N, 3) [m/s^2] of an estimator's IMU.

    None where nobody knows it: truth of a recorded flight does not tell what is felt.
    """
    imu = run.imu_of(estimator)
    if imu is None or len(run.t) < 3 or not np.nan_to_num(run.truth("dv")).any():
        return None
    t = column(run.dataset, f"sensors/{imu}/time")
    edges = np.arange(run.t[0], run.t[-1], BIAS_STEP_S)
    n = round(BIAS_MEAN_S / BIAS_STEP_S)
    if len(edges) < 2 * n:
        return None
    found = {"t": (edges[n:] + edges[:-n]) / 2}
    for what, name in (("gyro", "dtheta"), ("accel", "dv")):
        increments = _increments(run, imu, name)
        broken = ~_sound(increments)
        measured = np.vstack([np.zeros(3), np.cumsum(np.where(broken[:, None], 0.0, increments), axis=0)])
        lost = np.append(0, np.cumsum(broken))
        true = np.cumsum(run.truth(name), axis=0)
        at = np.searchsorted(t, edges + 1e-9, side="right")
        at_true = np.searchsorted(run.t, edges + 1e-9, side="right") - 1
        total = measured[at] - true[at_true]
        whole = lost[at[n:]] == lost[at[:-n]]
        found[what] = np.where(whole[:, None], (total[n:] - total[:-n]) / BIAS_MEAN_S, np.nan)
    return found


def _increments(run: Run, imu: str, name: str) -> Array:
    """Recorded increments (N, 3) of a unit in body axes, as truth is, however it is mounted; NaN if none can be so."""
    increments, errors = column(run.dataset, f"sensors/{imu}/{name}"), run.datasheet(imu)
    increments = np.where(_sound(increments)[:, None], increments, np.nan)
    return increments if errors is None else np.asarray(increments @ errors.C_sb)


def _sound(increments: Array) -> npt.NDArray[np.bool_]:
    """Which rows (N,) some IMU can have measured."""
    return np.asarray((np.abs(increments) < BROKEN).all(axis=1))


def longest(mask: npt.NDArray[np.bool_]) -> slice:
    """The longest stretch of rows that are all true."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    if not len(edges):
        return slice(0, 0)
    start, end = edges[np.argmax(edges[:, 1] - edges[:, 0])]
    return slice(int(start), int(end))


def _signals(run: Run, imu: str, rows: npt.NDArray[np.bool_]) -> tuple[float, Array, Array] | None:
    """Interval [s], rates [rad/s] and specific force [m/s^2] (N, 3) of the longest sound stretch of these rows."""
    t = column(run.dataset, f"sensors/{imu}/time")
    dtheta, dv = (_increments(run, imu, name) for name in ("dtheta", "dv"))
    if len(t) < 3:
        return None
    dt = float(np.median(np.diff(t)))
    sound = rows & _sound(dtheta) & _sound(dv)
    sound[1:] &= np.abs(np.diff(t) - dt) < 0.01 * dt  # no sample is missing
    part = longest(sound)
    return dt, dtheta[part] / dt, dv[part] / dt


def _at_rest(run: Run, imu: str) -> npt.NDArray[np.bool_]:
    """Which samples of the unit (N,) were measured while nothing moved, by the rows of truth around them."""
    still = np.linalg.norm(run.truth("v_n"), axis=1) < AT_REST_MPS
    still &= np.linalg.norm(run.truth("omega_b"), axis=1) < AT_REST_RADPS
    after = np.searchsorted(run.t, column(run.dataset, f"sensors/{imu}/time") - 1e-9)
    after = np.clip(after, 1, len(run.t) - 1)
    return np.asarray(still[after] & still[after - 1])


def allan_deviation(rate: Array, dt: float, sizes: npt.NDArray[np.intp]) -> Array:
    """Overlapping Allan deviation (K, ...) of a rate (N, ...) sampled every ``dt`` [s], for clusters of ``sizes`` (K,).

    With theta the integral of the rate and tau = m dt: sigma^2(tau) = <(theta(k + 2m) - 2 theta(k + m) + theta(k))^2>
    / (2 tau^2), over all k (IEEE Std 952-1997, annex C.1.1).
    """
    theta = np.concatenate([np.zeros((1, *rate.shape[1:])), np.cumsum(rate - rate.mean(axis=0), axis=0) * dt])
    found = []
    for m in sizes.tolist():
        second = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
        found.append(np.sqrt(np.mean(second**2, axis=0) / 2) / (m * dt))
    return np.array(found)


def allan(run: Run, imu: str) -> Figure | None:
    """Allan deviation while the unit was at rest, with the noise of its data sheet; None when it hardly was."""
    if len(run.t) < 3:
        return None
    signals = _signals(run, imu, _at_rest(run, imu))
    if signals is None or len(signals[1]) * signals[0] < REST_S:
        return None
    dt, *measured = signals
    largest = len(measured[0]) // LONGEST_SHARE
    sizes = np.unique(
        np.geomspace(1, largest, max(2, int(TAUS_PER_DECADE * np.log10(largest)))).round().astype(np.intp)
    )
    drawn = sheet(1, 2, height=4.2, shared=False)
    tau = np.asarray(sizes * dt, np.float64)
    sheets = _datasheet(run, imu, tau)
    panels = (("gyro", DEGPH, "Allan deviation of rate [deg/h]"), ("accel", MG, "of specific force [mg]"))
    for ax, signal, (what, scale, label) in zip(drawn.axes[0], measured, panels, strict=True):
        deviation = scale * allan_deviation(signal, dt, sizes)
        for k, colour in enumerate(tints(NEUTRAL)):
            ax.plot(tau, deviation[:, k], ".-", ms=3, lw=1.1, color=colour, label=AXES[k])
        for style, (name, curve) in zip((":", "--", "-.", "-"), sheets.get(what, {}).items(), strict=False):
            if curve.any():
                ax.plot(tau, scale * curve, color=PROMISED, lw=1.2, ls=style, label=f"data sheet: {name}")
        logarithmic(ax, along="x")
        ax.set_yscale("log")
        ax.set_ylim(deviation[deviation > 0].min() / 3, deviation.max() * 2)
        logarithmic(ax)
        ax.set_xlabel("averaging time [s]")
        ax.set_ylabel(label)
    drawn.legend(keys_of(drawn.axes.flat))
    return drawn.figure


def _datasheet(run: Run, imu: str, tau: Array) -> dict[str, dict[str, Array]]:
    """Allan deviations (N,) [rad/s], [m/s^2] at averaging times that the data sheet promises, one per kind of noise."""
    errors = run.datasheet(imu)
    if errors is None:
        return {}
    found = {}
    for what in ("gyro", "accel"):
        noise, in_run, in_run_tau, walk = _noise_of(errors, what)
        x = tau / in_run_tau  # of a Gauss-Markov process: IEEE Std 952-1997, annex C
        markov = in_run * np.sqrt(np.maximum(2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x)), 0.0))
        parts = {"white noise": noise / np.sqrt(tau), "in-run bias": markov, "bias walk": walk * np.sqrt(tau / 3)}
        found[what] = parts | {"all": np.sqrt(sum(curve**2 for curve in parts.values()))}
    return found


def _noise_of(errors: ImuErrors, what: str) -> tuple[float, float, float, float]:
    """White noise, in-run bias and its correlation time, and random walk of one kind of sensor."""
    keys = ("noise", "in_run", "in_run_tau", "random_walk")
    noise, in_run, in_run_tau, walk = (float(getattr(errors, f"{what}_{key}")) for key in keys)
    return noise, in_run, in_run_tau, walk


def spectra(run: Run, imu: str) -> Figure | None:
    """Amplitude spectral density of what the unit measured, of truth as far as it is recorded, and its white noise."""
    signals = _signals(run, imu, np.ones(len(column(run.dataset, f"sensors/{imu}/time")), bool))
    if signals is None or len(signals[1]) * signals[0] < 2 * SPECTRUM_S:
        return None
    dt, *measured = signals
    errors = run.datasheet(imu)
    drawn = sheet(3, 2, height=1.9)
    panels = (("gyro", "dtheta", np.rad2deg(1.0), "deg/s/√Hz"), ("accel", "dv", MG, "mg/√Hz"))
    for axes, signal, (what, name, scale, unit) in zip(drawn.axes.T, measured, panels, strict=True):
        frequency, density = _density(signal, dt)
        true_dt = float(np.median(np.diff(run.t)))
        true_frequency, true = _density(run.truth(name)[1:] / true_dt, true_dt)
        for k, ax in enumerate(axes):
            ax.plot(frequency, scale * density[:, k], color=NEUTRAL, lw=0.9, label="measured")
            if np.any(true > 0):  # nobody knows it of a recorded flight
                label = "truth, up to half the rate of the record"
                ax.plot(true_frequency, scale * true[:, k], color=TRUTH, lw=0.8, label=label)
            if errors is not None and (noise := _noise_of(errors, what)[0]):
                # A random walk of N per root second is white noise of one-sided density 2 N^2.
                ax.axhline(np.sqrt(2) * scale * noise, color=PROMISED, lw=1.2, ls="--", label="data sheet: white noise")
            ax.set_xlim(frequency[0], frequency[-1])
            logarithmic(ax, along="x")
            logarithmic(ax)
            ax.set_ylabel(f"{AXES[k]}\n[{unit}]")
        axes[0].set_title("rate" if what == "gyro" else "specific force", y=1.0, fontsize=10, loc="left")
        axes[-1].set_xlabel("frequency [Hz]")
    drawn.legend(keys_of(drawn.axes.flat), 0.25)
    return drawn.figure


def _density(signal: Array, dt: float) -> tuple[Array, Array]:
    """Frequencies (F,) [Hz] above 0, and root of the one-sided power spectral density (F, 3) by Welch's method."""
    from matplotlib.mlab import psd  # as scipy.signal.welch, which takes half a second to import

    size = min(len(signal), round(SPECTRUM_S / dt))
    window = np.hanning(size + 1)[:-1]
    power: Array = np.stack([psd(axis, size, 1 / dt, "mean", window, size // 2)[0] for axis in signal.T], axis=-1)
    frequency = np.fft.rfftfreq(size, dt).astype(float, copy=False)
    return frequency[1:], np.sqrt(power[1:])


OF_ESTIMATOR = (
    Plot(
        "{}_biases",
        "Estimated biases of the IMU. Coloured line: estimate; band: ±3 sigma as claimed; black: what the IMU measured"
        " less truth, mean of 60 s.",
        biases,
    ),
)
OF_UNIT = (
    Plot(
        "{}_allan",
        "Overlapping Allan deviation while at rest. Slate lines: the three axes as measured; dashed lines: what the"
        " data sheet promises, each kind of noise alone; full line: all of them.",
        allan,
        timed=False,
        pictured=True,
    ),
    Plot(
        "{}_spectra",
        "Amplitude spectra by Welch's method, stretches of 20 s. Slate: measured; black: truth, as far as the record's"
        " rate shows it; dashed: white noise of the data sheet.",
        spectra,
        timed=False,
        pictured=True,
    ),
)
