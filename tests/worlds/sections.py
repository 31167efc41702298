"""The section of each built-in kind of sensor."""

from testbed.sensors.registry import BUILT_IN

SECTIONS = {kind: one.section for kind, one in BUILT_IN.items()}
