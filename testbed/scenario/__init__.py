"""The scenario file: its `schema`, what can be wrong between keys (`mistakes`), and how that is said (`messages`)."""

from testbed.scenario.schema import Bounds, FeedbackConfig, Scenario, shipped

__all__ = ["Bounds", "FeedbackConfig", "Scenario", "shipped"]
