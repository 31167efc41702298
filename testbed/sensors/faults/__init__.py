"""Faults: what goes wrong with a sensor beyond its datasheet, and when.

A fault acts on samples that the healthy sensor has produced, so no noise stream is touched: other sensors keep their
bits, and so does this one outside the window. Faults on one channel act in the order of the file, each on what the one
before it left. A window [start, end) is in times of validity; after its end the sensor is as if nothing had been.

With tau = t - start [s] the kinds are::

    step         + size                                  ramp       + slope tau
    quadratic    + coefficient tau^2                     sine       + size sin(2 pi tau / period_s)
    exponential  + size (1 - exp(-tau / time_constant_s))
    spikes       + size on the first sample, and on the first after every period_s
    noise        white noise on top, so that the sensor's stated 1-sigma becomes factor times as large
    scale        the value times factor                  stuck      the last value before the window, or ``value``
    delay        the value of delay_s ago                dropout    no sample at all; an IMU's increments are NaN
    garbage      NaN, infinities and absurd numbers      slow       one sample of ``factor``; an IMU holds its rates
    intermittent a dropout during the first ``share`` of every period_s
    drag_off     spoofing: from the true position away along bearing_deg by velocity_mps tau +
                 acceleration_mps2 tau^2 / 2, and the velocity with it

Sizes are in the channel's unit, in another that fits it, or with ``unit = "sigma"`` in the sensor's own stated 1-sigma
of one sample: what a GNSS receiver reports, white noise elsewhere. What loses samples may name ``gyro`` or ``accel`` as
the channel of an IMU, and then loses these alone.
"""

from testbed.sensors.faults.acting import Faults, FaultTruth, label
from testbed.sensors.faults.channels import CHANNELS, Channel
from testbed.sensors.faults.kinds import DRAWN, Fault, FaultConfig, mistakes

__all__ = ["CHANNELS", "DRAWN", "Channel", "Fault", "FaultConfig", "FaultTruth", "Faults", "label", "mistakes"]
