"""Samples of one sensor as columns are those samples."""

import dataclasses

import numpy as np

from nav.columns import MANY, Samples, chosen, column, delivered, one_by_one
from nav.samples import FixType, GnssSample, MagnetometerSample

T = np.arange(10) * 0.2
FIELD_B = np.random.default_rng(3).standard_normal((10, 3))


def field(n=10):
    return delivered(MagnetometerSample, "compass", T[:n], 0.1, field_b=FIELD_B[:n])


def equal(a, b):
    return type(a) is type(b) and all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name)) and type(getattr(a, f.name)) is type(getattr(b, f.name))
        for f in dataclasses.fields(a)
    )


def test_each_is_the_one_that_would_have_been_made():
    single = [MagnetometerSample(t, t + 0.1, FIELD_B[k], "compass") for k, t in enumerate(T.tolist())]
    many = field()
    assert isinstance(many, Samples)
    assert len(many) == 10
    assert all(map(equal, many, single))
    assert all(equal(many[k], single[k]) for k in (0, 3, -1))
    assert all(map(equal, many[2:5], single[2:5]))
    assert all(map(equal, chosen(many, T > 0.7), chosen(single, T > 0.7)))
    assert np.array_equal(column(many, "field_b"), column(single, "field_b"))
    assert all(map(equal, one_by_one([single[0], many[1:3], single[3]]), single[:4]))


def test_few_are_made_at_once():
    assert isinstance(field(MANY), Samples)
    few = field(MANY - 1)
    assert isinstance(few, list)
    assert all(map(equal, few, field()))
    assert delivered(MagnetometerSample, "compass", T[:0], 0.0, field_b=FIELD_B[:0]) == []


def test_a_fix_has_the_types_of_its_fields():
    ones, nones = np.ones(10), np.ones((10, 3))
    kind = np.array([FixType.NO_FIX, FixType.FIX_3D] * 5, object)
    fixes = delivered(
        GnssSample, "gnss", T, 0.1, lat=ones, lon=ones, h=ones, v_n=nones, sigma_position_n=nones,
        sigma_velocity_n=nones, fix_type=kind, satellites=np.full(10, 7), hdop=ones, vdop=ones,
    )  # fmt: skip
    assert [fix.has_fix for fix in fixes] == [False, True] * 5
    assert fixes[1].fix_type is FixType.FIX_3D
    assert type(fixes[1].satellites) is int
    assert type(fixes[1].lat) is float
