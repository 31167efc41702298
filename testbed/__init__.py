"""The harness around `nav`: flight, sensors, the run, its record and its report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from testbed.errors import UserError

if TYPE_CHECKING:
    from testbed.loop.loop import RunResult, run
    from testbed.many.campaign import CampaignResult, campaign
    from testbed.many.check import Checked, check
    from testbed.scenario import Scenario
    from testbed.score.series import error_series

__all__ = [
    "CampaignResult",
    "Checked",
    "RunResult",
    "Scenario",
    "UserError",
    "campaign",
    "check",
    "error_series",
    "run",
]


def __getattr__(name: str) -> Any:
    # The command line must answer at once: nothing heavy is imported before it is asked for. (The loop's module is not
    # called run.py because importing such a submodule would replace the function `testbed.run` by the module.)
    if name == "Scenario":
        from testbed.scenario import Scenario

        return Scenario
    if name == "error_series":
        from testbed.score.series import error_series

        return error_series
    if name in ("run", "RunResult"):
        import testbed.loop.loop

        return getattr(testbed.loop.loop, name)
    if name in ("campaign", "CampaignResult"):
        import testbed.many.campaign

        return getattr(testbed.many.campaign, name)
    if name in ("check", "Checked"):
        import testbed.many.check

        return getattr(testbed.many.check, name)
    raise AttributeError(f"module 'testbed' has no attribute {name!r}")
