"""Zhu et al. 2020: a federated filter whose local filters inflate R, on a river with wrong transponder fixes.

`flight` flies the river and the outage; `claims` judges; `figure` draws.
"""

from testbed.papers import Job, Paper
from testbed.papers.zhu2020 import claims, figure, flight

PAPER = Paper(
    "Zhu et al. 2020: a robust federated filter under water",
    ("zhu2020.png",),
    lambda draws: [
        *(Job(flight.fly, (seed,)) for seed in draws.seeds),
        Job(flight.solve, (draws.seeds[0],)),
    ],
    claims.conclude,
    lambda results, out: figure.draw(results[0], out),
)
