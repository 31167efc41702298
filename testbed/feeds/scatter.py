"""What of a receiver's positions is another error at each fix, beside what it claims, and what filters take to last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from nav.earth import radii
from nav.samples import Array
from testbed.feeds.lateness import fixes
from testbed.feeds.survey import usual_step

Mask: TypeAlias = npt.NDArray[np.bool_]

LEAST_FIXES = 40
EVEN = 0.1  # of the usual step, by which others may differ
MOSTLY = 0.7  # of the claim, from which on most of its square is white
MORE, LESS = 1.5, 0.8  # times what is told
LEAST_NOISE = 0.005  # [m]
NORMAL = 1.4826  # sigma of normal errors over their median size
AXES = {"horizontal": [0, 1], "vertical": [2]}


def scatter(own: Sequence[Any]) -> Array | None:
    """White noise of the positions (3,), north, east, down, 1 sigma [m]; None where fixes are too few, or uneven.

    Of positions p every T the fourth difference has 70 times their variance, and (w T)^4 of what moves with a frequency
    w. Where there are velocities v, the difference of p_k - p_(k-1) - T (v_k + v_(k-1)) / 2 has 6 times it, and jerk
    times what v is late by. Each is the median's, so that a manoeuvre counts for little, and the lesser of both is
    taken: what else is in them adds to it.
    """
    t, v_n, place = fixes(own)
    new: Mask = np.asarray(np.isfinite(place).all(axis=1))
    new[1:] &= (np.diff(place, axis=0) != 0).any(axis=1)  # what is told again is no scatter
    t, v_n, place = t[new], v_n[new], place[new]
    if len(t) < LEAST_FIXES:
        return None
    place[:, 1] = np.unwrap(place[:, 1])
    step = usual_step(t)
    even: Mask = np.abs(np.diff(t) - step) < EVEN * step
    lat = float(np.median(place[:, 0]))
    north, east = radii(lat)
    metres = np.array([north, east * math.cos(lat), -1.0])
    p = (place - place[0]) * metres
    four: Mask = np.convolve(even, np.ones(4), "valid") == 4
    found = [_sigma(np.diff(p, 4, axis=0), four, 70)]
    if np.isfinite(v_n).any():
        off = np.diff(p, axis=0) - 0.5 * np.diff(t)[:, None] * (v_n[1:] + v_n[:-1])
        found.append(_sigma(np.diff(off, axis=0), even[1:] & even[:-1], 6))
    known = [one for one in found if one is not None]
    return np.min(known, axis=0) if known else None


def _sigma(differences: Array, even: Mask, factor: float) -> Array | None:
    sizes = np.abs(differences[even & np.isfinite(differences).all(axis=1)])
    return NORMAL * np.median(sizes, axis=0) / math.sqrt(factor) if len(sizes) >= LEAST_FIXES // 2 else None


def otherwise(own: Sequence[Any], told: Any) -> dict[str, float]:
    """The keys of a receiver's section that its fixes contradict, with what they show; ``told`` has the section's.

    Where a claim is mostly white noise, less of it lasts than is told; where nothing is claimed, noise may be more.
    """
    white = scatter(own)
    if white is None:
        return {}
    claims = np.array([one.sigma_position_n for one in own if one.has_fix]).reshape(-1, 3)
    known = claims[np.isfinite(claims).all(axis=1)]
    claim = np.median(known, axis=0) if len(known) else np.full(3, np.nan)
    keys = {}
    for axis, rows in AXES.items():
        noise, said = (math.sqrt(float(np.mean(one[rows] ** 2))) for one in (white, claim))
        if noise > MOSTLY * said:
            lasting = math.sqrt(max(said**2 - noise**2, 0.0))
            if lasting < LESS * told[f"{axis}_correlated_m"]:
                keys[f"{axis}_correlated_m"] = lasting
        elif math.isnan(said) and noise > max(MORE * told[f"{axis}_white_m"], LEAST_NOISE):
            keys[f"{axis}_white_m"] = noise
    return {key: float(f"{value:.2g}") for key, value in keys.items()}


def misjudged(name: str, own: Sequence[Any], section: Any) -> str:
    """What filters are told of a receiver that its fixes contradict, a sentence; empty where nothing is."""
    keys = otherwise(own, section.model_dump())
    if not keys:
        return ""
    said = ", ".join(f"{key} = {value:g}" for key, value in keys.items())
    return (
        f"{name}: its fixes scatter otherwise than filters are told, by more at once or by less that lasts: say {said}"
    )
