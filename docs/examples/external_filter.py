"""The program that the example `external.py` runs: gyros and the last GNSS fix. Python here; any language will do."""

import math
import signal
import sys


def turned(q, angle):
    """q times the turn by a small angle [rad], body axes."""
    w, x, y, z = q
    a, b, c = (0.5 * part for part in angle)
    q = (w - a * x - b * y - c * z, x + a * w + c * y - b * z, y + b * w - c * x + a * z, z + c * w + b * x - a * y)
    size = math.sqrt(sum(part * part for part in q))
    return tuple(part / size for part in q)


def main():
    t, fix, q, moved = 0.0, None, (1.0, 0.0, 0.0, 0.0), False
    for told in sys.stdin:
        what, *fields = told.split()
        if what == "imu":
            for _ in range(int(fields[0])):
                t, _, *angle = map(float, sys.stdin.readline().split()[:5])
                q = turned(q, angle)
        elif what == "gnss" and fields[-1] == "1.0":
            fix = [float(field) for field in fields[1:7]]
            if not moved:  # wings level, nose where it goes
                course = math.atan2(fix[4], fix[3])
                q, moved = (math.cos(course / 2), 0.0, 0.0, math.sin(course / 2)), True
        elif what == "estimate":
            state = [*fix, *q] if fix else [math.nan] * 10
            print(t, int(fix is not None), *state, flush=True)


signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it with the run, without a traceback
main()
