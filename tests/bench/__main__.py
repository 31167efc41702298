"""Speed of the product: ``python tests/bench --help``.

Machines differ and are noisy, ratios measured in one run much less so. All multiply on one thread, as the program does
unless the environment says otherwise. Peers come with the bench extra (`make bench` installs it): pyins (PyPI
python-ins), smsfusion and vqf.
"""

import os
import sys
from pathlib import Path

from testbed import threads

os.environ.update({name: value for name, value in threads.ONE.items() if name not in os.environ})

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # so that this folder is the package `bench`

from bench import filters, hour, live, pages, peers, runs
from bench.command import main

MEASURES = {
    measure.__name__: measure
    for measure in (
        runs.whole_run,
        runs.cpu_two_estimators,
        runs.cpu_main_scenario,
        runs.federation,
        runs.telemetry,
        runs.exports,
        pages.pages,
        peers.strapdown_alone,
        peers.ins_at_every_sample,
        peers.accuracy,
        filters.ahrs_batch,
        filters.federated,
        filters.unscented_period,
        hour.ins_hour,
        live.live,
        runs.start_up,
        runs.campaign_efficiency,
        runs.growth,
    )
}

if __name__ == "__main__":
    sys.exit(main(MEASURES))
