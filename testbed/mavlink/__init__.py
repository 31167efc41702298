"""The vehicle that a MAVLink ground station sees.

Out: `messages` says what each message holds, `stream` when it is due, `encode` makes frames of it, `link` is where they
go. In: `receive` reads frames, `signing` says whose they are, `answers` answers, with `parameters` and `mission`.
`publisher` joins the two: data comes in by `MavlinkPublisher.publish`, what is asked of the run goes out by
`MavlinkPublisher.requests`; nothing here is known to the rest of the testbed.
"""

from testbed.mavlink.link import log_path
from testbed.mavlink.publisher import MavlinkPublisher

__all__ = ["MavlinkPublisher", "log_path"]
