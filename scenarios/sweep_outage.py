"""How the position error grows with the length of the outage: a sweep from Python.

python scenarios/sweep_outage.py [--lengths 30 60 120 …] [--seeds 5] [--out runs/sweep_outage]

Flies `loiter_gnss_outage` with outages of several lengths and several seeds each, and plots the largest horizontal
error in the outage against its length.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from testbed import Scenario, run

START_S = 600
LENGTHS_S = (30, 60, 120, 240, 420, 600)


def sweep(lengths_s: Sequence[int], seeds: int) -> dict[int, list[float]]:
    """Largest horizontal error in the outage [m] by outage length [s], one value per seed."""
    errors: dict[int, list[float]] = {}
    for length in lengths_s:
        scenario = Scenario.load(
            "loiter_gnss_outage",
            [
                f"sensors.gnss.denied=[[{START_S}, {START_S + length}]]",
                f"duration_s={START_S + length + 30}",
            ],
        )
        errors[length] = [
            run(scenario, seed=seed).metrics["ins.outage_position_horizontal_max_m"] for seed in range(seeds)
        ]
        print(f"{length:4d} s: " + "  ".join(f"{e:6.1f}" for e in errors[length]) + " m", flush=True)
    return errors


def parser() -> argparse.ArgumentParser:
    """What can be given on the command line."""
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--lengths", type=int, nargs="+", default=LENGTHS_S, metavar="S", help="of the outages")
    arguments.add_argument("--seeds", type=int, default=5, metavar="N", help="flights per length")
    arguments.add_argument("--out", type=Path, default=Path("runs/sweep_outage"), metavar="DIR")
    return arguments


def main() -> None:
    """Sweep, print, plot."""
    options = parser().parse_args()
    errors = sweep(options.lengths, options.seeds)

    options.out.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for length, values in errors.items():
        axes.plot([length] * len(values), values, "o", color="0.6", markersize=4)
    axes.plot(list(errors), [np.median(v) for v in errors.values()], "o-", color="#0072b2", label="median")
    axes.set(xlabel="outage [s]", ylabel="largest horizontal error [m]", title="INS error against outage length")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(options.out / "sweep_outage.png", dpi=120)
    print(f"figure: {options.out / 'sweep_outage.png'}")


if __name__ == "__main__":
    main()
