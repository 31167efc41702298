"""Zhou et al. 2025: SINS/GNSS/odometer, the completely reset SPRT, and fusion by adaptive normalised weights.

`replays` judges the detectors on ideal residuals, `fusion` the federation with them on the circuit, `figure` draws.
"""

from testbed.papers import Job, Paper
from testbed.papers.zhou2025 import figure, fusion, replays

PAPER = Paper(
    "Zhou et al. 2025: completely reset SPRT and adaptive normalised weights",
    ("zhou2025.png",),
    lambda draws: [
        *(Job(fusion.fly, (seed, seed == draws.seeds[0])) for seed in draws.seeds),
        *(Job(replays.replay, (seed,)) for seed in draws.seeds),
    ],
    lambda results: [
        *replays.claims(results[len(results) // 2 :]),
        *fusion.claims(results[: len(results) // 2]),
    ],
    lambda results, out: figure.draw(results[0], results[len(results) // 2 :], out),
)
