"""An estimator that is a program of its own, in any language: fed and answering over a pipe, a line each way.

To the program, fields separated by blanks, SI units and radians, ``nan`` where there is nothing:

    imu N                      N lines follow:  t dt dtheta_x dtheta_y dtheta_z dv_x dv_y dv_z
    gnss t lat lon h v_north v_east v_down sigma_north sigma_east sigma_down fix
    magnetometer t x y z       [T], body axes
    barometer t pressure       [Pa]
    airspeed t eas             [m/s]
    estimate                   asks for one line in answer:

    t aligned lat lon h v_north v_east v_down q_w q_x q_y q_z

``aligned`` is 0 or 1. Nothing else is answered; the end of its input is the end of the run. An answer that takes longer
than `ANSWER_S` is the end of the program.
"""

import subprocess
import threading
import weakref
from contextlib import suppress

import numpy as np

from nav.samples import AirspeedSample, BarometerSample, Estimate, GnssSample, MagnetometerSample, Status

ANSWER_S = 10.0
STATE = 10  # numbers of a state


class External:
    """Kind ``./external.py:External`` with the key ``command``, a list: the program and its arguments.

    Files in it are relative to the scenario, as the file in ``kind`` is.
    """

    def __init__(self, rig, command):
        pipe = subprocess.PIPE
        if isinstance(command, str):
            raise ValueError(f"command is a list: the program and its arguments, such as {command.split()}")
        self.program = subprocess.Popen(command, cwd=rig.folder, stdin=pipe, stdout=pipe, text=True)
        self.too_late = False
        weakref.finalize(self, stop, self.program)  # at the end of the run, or of Python

    def propagate(self, imu):
        rows = np.column_stack([imu.t, imu.dt, imu.dtheta, imu.dv]).tolist()
        self.send(f"imu {len(rows)}\n" + "".join(line(*row) for row in rows))

    def update(self, sample):
        match sample:
            case GnssSample():
                place = (sample.t, sample.lat, sample.lon, sample.h)
                self.tell("gnss", *place, *sample.v_n, *sample.sigma_position_n, int(sample.has_fix))
            case MagnetometerSample():
                self.tell("magnetometer", sample.t, *sample.field_b)
            case BarometerSample():
                self.tell("barometer", sample.t, sample.pressure)
            case AirspeedSample():
                self.tell("airspeed", sample.t, sample.eas)

    def tell(self, what, *fields):
        self.send(f"{what} " + line(*fields))

    def send(self, text):
        try:
            self.program.stdin.write(text)
        except BrokenPipeError:
            raise self.ended() from None

    def ended(self):
        stop(self.program)
        return RuntimeError(f"the program has ended with exit code {self.program.returncode}")

    def give_up(self):
        self.too_late = True
        self.program.kill()  # which ends whatever waits for it

    def estimate(self):
        late = threading.Timer(ANSWER_S, self.give_up)
        late.start()
        try:
            self.send("estimate\n")
            with suppress(BrokenPipeError):
                self.program.stdin.flush()
            answer = self.program.stdout.readline()
        finally:
            late.cancel()
        if self.too_late:
            raise RuntimeError(f"the program has not answered for {ANSWER_S:g} s")
        if not answer:
            raise self.ended()
        try:
            t, aligned, *state = map(float, answer.split())
        except ValueError:
            raise RuntimeError(f"the program has answered {answer!r}") from None
        if aligned != 1:
            return Estimate.of(t)
        if len(state) != STATE:
            raise RuntimeError(f"the program has answered {len(state)} numbers of its state, not {STATE}: {answer!r}")
        lla, v_n, q_nb = (np.array(part) for part in (state[:3], state[3:6], state[6:]))
        return Estimate.of(t, q_nb=q_nb, lla=lla, v_n=v_n, status=Status.ALIGNED)


def stop(program):
    """End its input, at which it should end; one that hangs does not outlive the run."""
    with suppress(BrokenPipeError):
        program.stdin.close()
    program.stdout.close()
    try:
        program.wait(timeout=5)
    except subprocess.TimeoutExpired:
        program.kill()
        program.wait()


def line(*fields):
    return " ".join(map(repr, map(float, fields))) + "\n"
