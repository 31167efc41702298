"""What a worker process of a pool's own does before it takes tasks: preloaded, by its name, by Dask."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time

from testbed.many.pool import PARENT

LOOK_S = 0.5


def _end_with(parent: int) -> None:
    """A task that has begun goes on when the scheduler has gone, and Dask waits for it half a minute."""
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


# Tasks are done in a thread, beside which no process may be forked; all cores are busy anyway.
multiprocessing.current_process().daemon = True
threading.Thread(target=_end_with, args=(int(os.environ[PARENT]),), daemon=True).start()
