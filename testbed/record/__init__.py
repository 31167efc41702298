"""One netCDF-4/HDF5 file per run: truth, sensors, estimators with every innovation, and events.

Layout, one group each, every group with its own time axis::

    truth                                    the true state at the record rate
    sensors/<name>                           what the sensor delivered
    estimators/<name>                        state, sigmas, 9x9 covariance, further states
    estimators/<name>/innovations/<aid>      what became of each aiding sample
    faults                                   what was made to go wrong; time is when it begins
    requests                                 what was asked of the run while it went on
    events                                   severity and text

Every variable carries ``units``, ``long_name`` and, where it has one, ``frame``. The root carries the scenario text,
seed and versions. The dimension is ``time``, except ``sample_time`` for innovations: a nested group may not reuse its
parent's dimension with other values.

Rows are written as they come, and whoever reads a record of a run that was killed finds those of the last second or
less left out. A run that ends compresses its record.
"""
