"""Which kinds of estimator there are: the section and the builder of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nav import _jit
from nav.ahrs.steps import advance
from nav.state import propagate
from testbed import plugins
from testbed.errors import UserError, choice, shown
from testbed.estimators import ahrs, custom, federated, ins, outside
from testbed.estimators.lane import Lane
from testbed.estimators.rig import Rig
from testbed.estimators.section import EstimatorSection


@dataclass(frozen=True, slots=True)
class Kind:
    """The keys of an ``[[estimator]]`` of this kind, and what builds it from them.

    ``kernel``, of a kind that has any, is the largest that every one of this kind needs.
    """

    section: type[EstimatorSection]
    build: Callable[[Any, Rig], Lane]
    kernel: Callable[..., object] | None = None


BUILT_IN: Mapping[str, Kind] = {
    "ins": Kind(ins.InsSection, ins.build, propagate),
    "federated": Kind(federated.FederatedSection, federated.build, propagate),
    "ahrs": Kind(ahrs.AhrsSection, ahrs.build, advance),
    "px4": Kind(outside.Px4Section, outside.build),
    "ardupilot": Kind(outside.ArduPilotSection, outside.build),
}
CUSTOM = Kind(custom.CustomSection, custom.build)


def find(kind: str) -> Kind:
    """The kind of this name: built in, installed (an entry point), or a class, ``"module:Class"``.

    Raises UserError when it is none of these.
    """
    if kind in BUILT_IN:
        return BUILT_IN[kind]
    if ":" in kind or kind in plugins.installed(custom.GROUP):
        return CUSTOM
    known = [*BUILT_IN, *plugins.installed(custom.GROUP)]
    text = f"there is no kind {shown(kind)}: {choice(kind, known)}"
    raise UserError(f'{text}, or name a class of your own, such as "./filters.py:Mine" or "mypackage.filters:Mine"')


def is_kept(sections: Sequence[EstimatorSection]) -> bool:
    """Whether the largest kernel of each of these estimators has been compiled before."""
    kernels = {find(section.kind).kernel for section in sections}
    return all(_jit.is_kept(kernel) for kernel in kernels if kernel is not None)


def build(sections: Sequence[EstimatorSection], rig: Rig) -> dict[str, Lane]:
    """The estimators of these sections by name, not yet aligned. Raises UserError when a class can't be had."""
    return {section.name: find(section.kind).build(section, rig) for section in sections}
