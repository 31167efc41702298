"""``kind = "federated"``: local filters that are fused, each with detectors that isolate a faulty sensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from nav.aids import Aid
from nav.detection import (
    ChiSquare,
    Detector,
    Eraim,
    Glr,
    Mean,
    Never,
    Reset,
    Sprt,
    WindowMean,
    exponential,
    plain,
)
from nav.federated import Federated
from nav.federation import Config, Local
from nav.horizon import FusionHorizon
from nav.monitor import MonitoredAid, Patience
from nav.weighting import MahalanobisInflation, Policy, SageHusa
from testbed.estimators.datasheet import aid_of, imu_model
from testbed.estimators.ins import scaling
from testbed.estimators.lane import Lane, handover_errors, mountings
from testbed.estimators.rig import Rig
from testbed.estimators.section import (
    ONE_EACH,
    SEVERAL,
    Engine,
    EstimatorSection,
    Gust,
    Handover,
    Mistake,
    Slip,
    States,
    TurnRate,
    WindWalk,
    aid_mistakes,
    slip_mistakes,
)
from testbed.schema import IDENTIFIER, Section
from testbed.sensors import SensorConfig, custom, geomagnetic_field_n

# Per sample, of detectors that judge by one sample, and of those that gather many.
SNAPSHOT_FALSE_ALARM, GATHERED_FALSE_ALARM = 1e-3, 1e-6


class DetectorSection(Section):
    """What judges the samples of a local filter; ``false_alarm`` is the probability per sample (`nav.detection`)."""

    kind: Literal["chi_square", "eraim", "sprt", "glr", "none"] = Field(
        default="chi_square", description="how the samples are judged"
    )
    false_alarm: float | None = Field(
        default=None,
        gt=0,
        lt=0.5,
        description="probability per sample without a fault; none: 1e-3, and 1e-6 for sprt and glr",
    )
    mean: Literal["plain", "window", "exponential"] = Field(
        default="exponential", description="sprt: of what it has gathered"
    )
    forgetting: float = Field(
        default=0.95, gt=0, lt=1, description="sprt, mean exponential: what a sample leaves of the weight before"
    )
    reset: Literal["none", "fast", "complete"] = Field(default="complete", description="sprt: when a fault seems over")
    window_s: float = Field(
        default=40.0,
        gt=0,
        le=600,
        description="glr: how long ago the fault may have begun; sprt, mean window: its span",
    )
    coloured: bool = Field(
        default=True, description="sprt, glr: widened by how far the innovations turn out not to be white"
    )

    @model_validator(mode="after")
    def _own_keys(self) -> Self:
        for key, kinds, means in (
            ("mean", ("sprt",), ()),
            ("forgetting", ("sprt",), ("exponential",)),
            ("reset", ("sprt",), ()),
            ("window_s", ("glr", "sprt"), ("window",)),
            ("coloured", ("sprt", "glr"), ()),
        ):
            if key in self.model_fields_set and self.kind not in kinds:
                named = " or ".join(map(repr, kinds))
                raise ValueError(f"{key} is a key of kind {named}, not of {self.kind!r}: leave it out")
            if key in self.model_fields_set and self.kind == "sprt" and means and self.mean not in means:
                named = " or ".join(map(repr, means))
                raise ValueError(f"{key} is a key of mean {named}, not of {self.mean!r}: leave it out")
        if self.kind == "none" and self.false_alarm is not None:
            raise ValueError("false_alarm is no key of kind 'none', which condemns nothing: leave it out")
        return self


class PolicySection(Section):
    """What the variances of a sample are taken for (`nav.weighting`).

    ``inflate`` makes the R of a suspect sample that the detector has let pass so large that its distance is at the
    limit (`MahalanobisInflation`); ``sage_husa`` learns R from the residuals, and the detector judges by that.
    """

    kind: Literal["inflate", "sage_husa"] = Field(description="weaken what is suspect, or learn the noise")
    false_alarm: float = Field(default=0.01, gt=0, lt=0.5, description="inflate: of the limit, probability per sample")
    reject_above: float | None = Field(
        default=None, gt=0, description="inflate: squared distance to leave out; none: never"
    )
    b: float = Field(default=0.97, ge=0.5, lt=1, description="sage_husa: forgetting factor per sample")

    @model_validator(mode="after")
    def _own_keys(self) -> Self:
        for key in self.model_fields_set - {"kind"}:
            kind = "sage_husa" if key == "b" else "inflate"
            if kind != self.kind:
                raise ValueError(f"{key} is a key of kind {kind!r}, not of {self.kind!r}: leave it out")
        return self


class LocalSection(Section):
    """One local filter of a federated estimator."""

    name: str = Field(description="what reports and metrics call it")
    aids: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="sensors whose samples it uses, by their names"
    )
    share: float | None = Field(default=None, gt=0, le=1, description="of the information; all alike without")
    engine: Engine = "linear"
    detector: DetectorSection = Field(default=DetectorSection(), description="what judges the samples")
    policy: PolicySection | None = Field(default=None, description="what it does to R; none: R is as told")


class FederatedSection(EstimatorSection):
    """Keys of a federated estimator, which lists its aids by local filter (`nav.federation.Config`)."""

    kind: Literal["federated"] = "federated"
    locals: tuple[LocalSection, ...] = Field(default=(), description="the local filters")
    states: States = "biases"
    turn_degps: TurnRate = None
    gust_mps: Gust = None
    wind_walk_mps_per_sqrt_s: WindWalk = None
    handover: Handover | None = Field(default=None, description="how well the start is known; none: it aligns")
    nonholonomic_mps: Slip | None = None
    structure: Literal["no_reset", "full_reset", "partial"] = Field(
        default="no_reset", description="what the fusion gives back to the local filters"
    )
    sharing: Literal["fixed", "by_covariance", "none"] = Field(
        default="fixed", description="how the common information is divided among the local filters"
    )
    combination: Literal["information", "scalar", "covariance_intersection"] = Field(
        default="information", description="how the local estimates are fused"
    )
    retention: float = Field(default=0.5, ge=0, le=1, description="of a partial reset: 0 is none, 1 a full one")
    weighting: Literal["none", "normalised"] = Field(
        default="none", description="normalised: a sample counts for less the nearer its detector is to an alarm"
    )
    fusion_period_s: float = Field(
        default=1.0, ge=0, le=60, description="from one fusion to the next; 0: at every sample"
    )
    isolate_after: int = Field(default=3, ge=1, description="consecutive condemned samples until it is left out")
    isolate_s: float = Field(default=3.0, ge=0, le=60, description="and for at least this long")
    readmit_after: int = Field(default=10, ge=1, description="consecutive sound samples")
    recall_s: float | None = Field(
        default=None, ge=1, le=600, description="isolated, a filter goes back by this; none: to the others' solution"
    )
    cross_check: bool = Field(default=False, description="of the local filters with each other; needs no_reset")

    def aiding(self, sensors: Mapping[str, SensorConfig]) -> tuple[str, ...]:
        """The names of those sensors whose samples it is handed once aligned."""
        return tuple(dict.fromkeys(name for local in self.locals for name in local.aids))

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        yield from super().mistakes(sensors)
        if not self.locals:
            yield ("locals",), 'is missing: add local filters, such as [{ name = "gnss", aids = ["gnss"] }]'
        names = [local.name for local in self.locals]
        for index, local in enumerate(self.locals):
            where = ("locals", index)
            if not IDENTIFIER.fullmatch(local.name):
                yield (*where, "name"), "is made of letters, digits and _, and does not begin with a digit"
            elif local.name in names[:index]:
                yield (*where, "name"), f"{local.name!r} is taken by a local filter above: give each its own name"
            for path, text in aid_mistakes(self.kind, local.aids, sensors, ONE_EACH | SEVERAL, own=True):
                yield (*where, *path), text
        yield from slip_mistakes(self.nonholonomic_mps, self.aiding(sensors), sensors)
        shares = [local.share for local in self.locals if local.share is not None]
        if shares and (len(shares) < len(names) or abs(sum(shares) - 1) > 1e-6):
            yield ("locals",), f"the shares of all local filters must add up to 1, not {sum(shares):g}: or give none"
        if self.recall_s is not None and self.structure != "no_reset":
            yield ("recall_s",), f"structure {self.structure!r} spreads what it would take back: leave one out"
        if self.combination == "information" and self.sharing == "none" and self.structure != "no_reset":
            yield (
                ("sharing",),
                f"structure {self.structure!r} would count the same information again and again: share it",
            )
        if self.cross_check and (self.structure != "no_reset" or self.combination != "information"):
            text = 'compares independent filters: it needs structure = "no_reset" and combination = "information"'
            yield ("cross_check",), text
        if self.combination != "information" and self.sharing != "none":
            yield ("sharing",), f'combination {self.combination!r} needs no shares: set sharing = "none"'


def build(section: FederatedSection, rig: Rig) -> Lane:
    """Local filters, each told of its own sensors as an INS would be."""
    return lane(section, rig, configuration(section, rig))


def configuration(section: FederatedSection, rig: Rig) -> Config:
    """What the federation is told."""
    errors = rig.imu_errors(section.imu, *section.spare_imus)
    air = rig.air(section.gust_mps, section.wind_walk_mps_per_sqrt_s)

    def aid(name: str) -> Aid | None:
        return aid_of(name, rig, errors, air, section.nonholonomic_mps)

    used = dict.fromkeys(name for local in section.locals for name in local.aids)
    # Without a receiver or magnetometer among the aids, the first in the file serves the alignment.
    for kind in ("gnss", "magnetometer"):
        if all(rig.sensors[name].kind != kind for name in used):
            used |= dict.fromkeys([name for name, s in rig.sensors.items() if s.kind == kind][:1])
    aids = {name: made for name in used if (made := aid(name)) is not None}  # one of the user's may aid none
    custom.require_alike(aids.values())
    local_filters = tuple(
        Local(
            local.name,
            tuple(
                MonitoredAid(
                    aids[name],
                    partial(_detector, local.detector),
                    _policy(local.policy),
                    local.detector.kind in ("sprt", "glr") and local.detector.coloured,
                )
                for name in local.aids
                if name in aids
            ),
            local.share,
            scaling(local.engine),
        )
        for local in section.locals
    )
    return Config(
        imu_model(errors, rig.turn_rate(section.turn_degps), section.states, rig.usual),
        local_filters,
        structure=section.structure,
        sharing=section.sharing,
        combination=section.combination,
        retention=section.retention,
        weighting=section.weighting,
        fusion_period_s=section.fusion_period_s,
        patience=Patience(section.isolate_after, section.isolate_s, section.readmit_after),
        recall_s=section.recall_s,
        cross_check=section.cross_check,
        mounting_sigma=0.0 if section.states == "matrix" else errors.accel_misalignment,
        alignment_aids=tuple(aids.values()),
    )


def lane(section: FederatedSection, rig: Rig, config: Config) -> Lane:
    """The estimator of a ``section`` that is told ``config``."""
    federated = Federated(config, partial(geomagnetic_field_n, date=rig.site.date))
    used = tuple(aid.sensor for aid in config.alignment_aids)
    imus, voter = mountings(section, rig)
    imu = rig.imu(section.imu)
    return Lane(
        FusionHorizon(federated, rig.lag_s(used), coning=imu.rate_hz < rig.tick_rate_hz),
        imus,
        used,
        handover_errors(section.handover, imu.errors().lever_arm_b, rig.seed),
        voter,
        spacing_s=rig.spacing_s(used),
    )


def _detector(section: DetectorSection) -> Detector:
    """A detector as the scenario says.

    Evidence that is gathered over samples is correlated from one to the next: a false alarm lasts, and must be rarer.
    """
    match section.kind:
        case "chi_square":
            return ChiSquare(section.false_alarm or SNAPSHOT_FALSE_ALARM)
        case "eraim":
            return Eraim(section.false_alarm or SNAPSHOT_FALSE_ALARM)
        case "sprt":
            return Sprt(section.false_alarm or GATHERED_FALSE_ALARM, _mean(section), Reset(section.reset))
        case "glr":
            return Glr(section.false_alarm or GATHERED_FALSE_ALARM, section.window_s)
        case "none":
            return Never()


def _mean(section: DetectorSection) -> Mean:
    """What a sequential test remembers."""
    match section.mean:
        case "plain":
            return plain()
        case "window":
            return WindowMean(section.window_s)
        case "exponential":
            return exponential(section.forgetting)


def _policy(section: PolicySection | None) -> Callable[[], Policy] | None:
    """What makes the measurement policy of a sensor, as the scenario says."""
    if section is None:
        return None
    if section.kind == "sage_husa":
        return partial(SageHusa, section.b)
    return partial(MahalanobisInflation, section.false_alarm, section.reject_above or math.inf)
