"""Logs as autopilots write them: one clock, and messages of several sizes one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from nav.samples import Array

Rows: TypeAlias = npt.NDArray[Any]  # structured: the fields of a message
Bytes: TypeAlias = npt.NDArray[np.uint8]  # messages (N, size)
Stamps: TypeAlias = npt.NDArray[np.int64]  # times on the log's clock [us]

START_US = 1_000_000  # of the run on the log's clock: to an autopilot a stamp of 0 means never


def stamps(t: Array) -> Stamps:
    """Times from the start of the run [s] on the log's clock (N,) [us]."""
    return START_US + np.rint(np.asarray(t, float) * 1e6).astype(np.int64)


def in_order(parts: Sequence[tuple[npt.NDArray[np.integer], Bytes]]) -> bytes:
    """Messages (N, size) of several sizes, with the times of each, one after the other as time goes on."""
    if not parts:
        return b""
    sizes = np.concatenate([np.full(len(framed), framed.shape[1]) for _, framed in parts])
    order = np.argsort(np.concatenate([stamps for stamps, _ in parts]), kind="stable")
    starts = np.empty(len(sizes), int)
    starts[order] = np.cumsum(sizes[order]) - sizes[order]
    whole = np.empty(sizes.sum(), np.uint8)
    done = 0
    for _, framed in parts:
        at = starts[done : done + len(framed)]
        for k, column in enumerate(framed.T):
            whole[at + k] = column
        done += len(framed)
    return whole.tobytes()
