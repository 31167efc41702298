"""The vehicle that a MAVLink ground station sees.

`messages` says what each message holds, `encode` makes frames of it, `stream` sends each at its rate, `link` is where
they go. Data comes in by `MavlinkPublisher.publish`; nothing here is known to the rest of the testbed.
"""

from testbed.mavlink.link import log_path
from testbed.mavlink.stream import MavlinkPublisher

__all__ = ["MavlinkPublisher", "log_path"]
