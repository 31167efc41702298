"""What comes through of an own sensor: only samples, as they were given."""

import dataclasses
import os
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nav.samples import MagnetometerSample, WindSample
from testbed.errors import UserError
from testbed.motion.table import TruthBlock
from testbed.sensors import custom, registry
from testbed.sensors.magnetometer import MagnetometerConfig


class Restless:
    """Changes what is everybody's, wherever it is asked."""

    sensor, parts, states = "radar", (), ()

    def __init__(self, *_: Any) -> None:
        os.chdir("/")
        np.seterr(all="raise")

    def sense(self, truth: Any) -> Any:
        Restless()
        yield from map(Restless, ())

    def blocks(self) -> Any:
        Restless()
        return []

    aid = classmethod(lambda cls, *_: cls())


@pytest.mark.parametrize(
    "ask",
    [
        lambda section: custom.made("radar", section),
        lambda section: custom.Guard("radar", section, object.__new__(Restless)).sense(TruthBlock.empty(0, 1)),
        lambda section: custom.aid(Restless.aid, "radar", section, None),
        lambda section: custom.AidGuard("radar", "radar", object.__new__(Restless)).blocks(),
    ],
)
def test_wherever_it_is_asked_working_folder_and_error_state_are_put_back(
    ask: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry._BY_SECTION, MagnetometerConfig, registry.Kind(MagnetometerConfig, Restless))
    before = np.geterr()
    with suppress(UserError):  # of an aid without measure
        ask(MagnetometerConfig())
    assert (Path.cwd(), np.geterr()) == (tmp_path, before)


def sensed(given: Any, seen_as: Any = lambda array: array) -> list[list[float]]:
    """The fields of three blocks of a sensor that writes into one array, of samples as ``given`` by a list or so."""
    array = np.zeros(3)

    def samples() -> Any:
        for k in range(3):
            array[:] += 1
            yield MagnetometerSample(0.1 * k, 0.1 * k, seen_as(array), "radar")

    guard = custom.Guard("radar", MagnetometerConfig(), SimpleNamespace(sense=lambda truth: given(samples())))
    return [one.field_b.tolist() for _ in range(3) for one in guard.sense(until(1.0))]


def test_an_array_that_is_written_anew_for_each_sample_is_copied() -> None:
    """All samples had what was in it in the end; of those of a list it can't be had any more, and is told."""
    assert sensed(lambda samples: samples) == [[k] * 3 for k in range(1, 10)]
    assert sensed(lambda samples: [next(samples)]) == [[k] * 3 for k in range(1, 4)]
    with pytest.raises(UserError, match="gave one array as field_b of several samples, and overwrote it: give each"):
        sensed(list)
    with pytest.raises(UserError, match="overwrote it: give each a copy"):
        sensed(list, lambda array: array[:])  # another view each time, of the same numbers


def test_samples_of_ours_may_have_two_numbers() -> None:
    wind = WindSample(0.0, 0.0, np.zeros(2), 0.0, 1.0, "radar")
    guard = custom.Guard("radar", MagnetometerConfig(), SimpleNamespace(sense=lambda truth: [wind]))
    assert guard.sense(TruthBlock.empty(0, 1))[0].wind_n.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("kind", [np.float32, np.int64, np.array])
def test_times_are_numbers_of_python(kind: Any) -> None:
    """Single precision was compared with other times in single precision or not, by how the run was cut."""
    made = [MagnetometerSample(kind(1), kind(2), np.ones(3), "radar")]
    guard = custom.Guard("radar", MagnetometerConfig(), SimpleNamespace(sense=lambda truth: made))
    (sample,) = guard.sense(until(1.0))
    assert (sample.t, sample.t_arrival) == (1, 2)
    assert {type(sample.t), type(sample.t_arrival)} <= {float, int}


def test_what_is_no_dataclass_is_told_whatever_its_times_are() -> None:
    given = SimpleNamespace(t=np.float32(1), t_arrival=np.array(1.0), sensor="radar")
    guard = custom.Guard("radar", MagnetometerConfig(), SimpleNamespace(sense=lambda truth: [given]))
    with pytest.raises(UserError, match="gave SimpleNamespace where a sample was expected: a dataclass with t"):
        guard.sense(TruthBlock.empty(0, 1))


def test_an_array_that_stays_as_it_is_may_be_in_all_samples() -> None:
    array = np.ones(3)
    made = [MagnetometerSample(0.1 * k, 0.1 * k, array, "radar") for k in range(3)]
    guard = custom.Guard("radar", MagnetometerConfig(), SimpleNamespace(sense=lambda truth: made))
    for _ in range(2):
        assert [one.field_b.tolist() for one in guard.sense(until(1.0))] == [[1.0] * 3] * 3


def until(t: float) -> TruthBlock:
    """A block of one row at ``t`` [s]."""
    block = TruthBlock.empty(0, 1)
    block.t[:] = t
    return block


def guarded(sample: Any) -> Any:
    """What comes through of one sample in a block that ends at 1 s; the sensor has 10 Hz."""
    guard = custom.Guard("radar", MagnetometerConfig(rate_hz=10), SimpleNamespace(sense=lambda truth: [sample]))
    (given,) = guard.sense(until(1.0))
    return given


def of(value: Any, name: str = "value", **metadata: Any) -> Any:
    """A sample with one field beside those that every one has."""
    fields = [("t", float), ("t_arrival", float), (name, Any, dataclasses.field(metadata=metadata))]
    made = dataclasses.make_dataclass("Own", [*fields, ("sensor", str, "radar")], frozen=True)
    return made(1.0, 1.0, value)


@pytest.mark.parametrize("given", [[1.0, 2.0], (1.0, 2.0), [1, 2]])
def test_a_list_or_a_tuple_is_an_array(given: Any) -> None:
    """It was let through, and the record then ended in an AttributeError."""
    value = guarded(of(given)).value
    assert isinstance(value, np.ndarray)
    assert (value.dtype, value.tolist()) == (np.dtype(float), [1.0, 2.0])


@pytest.mark.parametrize(
    ("sample", "says"),
    [
        (of([]), "a sample whose value is []: it must be a number or a list of them"),
        (of("1.5"), 'a sample whose value is "1.5": it must be a number or a list of them'),
        (of(["1", "2"]), 'a sample whose value is ["1", "2"]: it must be a number'),
        (of([1.0, "2"]), 'a sample whose value is [1.0, "2"]: it must be a number'),
        (of(np.array(["1", 2], dtype=object)), "a sample whose value is \"['1' 2]\": it must be a number"),
        (of(b"1"), "a sample whose value is \"b'1'\": it must be a number"),
        (of(np.datetime64("2020-01-01", "s")), 'a sample whose value is "2020-01-01T00:00:00": it must be'),
        (of(10**400), "a sample whose value is an integer beyond 1.8e308: it must be a number"),
        (of([10**5000]), "a sample whose value is an integer beyond 1.8e308: it must be a number"),
        (of(1.0, "time"), "a sample with a field time, which the record has already: give it another name"),
        (of(1.0, "component"), "a sample with a field component, which the record has already"),
        (of(1.0, meaning="\udc80"), r'a sample whose value has the meaning "\udc80", which'),
        (MagnetometerSample(1001.0, 1001.0, np.ones(3), "radar"), "a sample of 1001 s inside a block of truth that"),
        (MagnetometerSample(1.11, 1.2, np.ones(3), "radar"), "a sample of 1.11 s inside a block of truth that"),
    ],
)  # fmt: skip
def test_what_the_record_cant_have_is_told(sample: Any, says: str) -> None:
    with pytest.raises(UserError) as told:
        guarded(sample)
    assert f"sense gave {says}" in str(told.value)


def test_a_stamp_may_be_late_and_a_sample_of_before() -> None:
    """By jitter of its own, less than a period; of the middle of what it saw, or held back."""
    for t, arrival in ((1.09, 1.09), (1.0, 3.0), (0.1, 0.1), (0.1, 1.0)):
        assert guarded(MagnetometerSample(t, arrival, np.ones(3), "radar")).t == t
