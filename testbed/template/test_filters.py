"""The filter in flight. Run it with `pytest`; the first run takes longer, as kernels are compiled."""

from pathlib import Path

import testbed


def test_mine_stays_near_an_ins() -> None:
    """Both fly on the same samples, so their errors can be compared."""
    result = testbed.run(testbed.Scenario.load(Path(__file__).parent / "first.toml"))
    assert not result.failure
    assert result.metrics["mine.position_horizontal_rms_m"] < 3
    assert result.metrics["mine.velocity_rms_mps"] < 10 * result.metrics["ins.velocity_rms_mps"]
    errors = testbed.error_series(result, "mine")
    assert errors.loc[60:, "heading_deg"].abs().max() < 10
