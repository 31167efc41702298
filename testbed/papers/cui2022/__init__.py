"""Cui et al. 2022: fault-tolerant federated filter of SINS, GPS, Doppler radar and star tracker.

`flight` flies the six faults of table 2, and none; `claims` judges; `figure` draws.
"""

from testbed.papers import Job, Paper
from testbed.papers.cui2022 import claims, figure, flight

PAPER = Paper(
    "Cui et al. 2022: fault-tolerant federated SINS, GPS, Doppler and star tracker",
    ("cui2022.png",),
    lambda draws: [Job(flight.fly, (seed, seed == draws.seeds[0])) for seed in draws.seeds],
    claims.claims,
    lambda results, out: figure.draw(results[0], out),
)
