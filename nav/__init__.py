"""Navigation from sensors alone: strapdown, error-state filters, aiding, detection.

These conventions hold everywhere in the project, in `testbed` too.

Frames
    ``i`` inertial, ``e`` ECEF (WGS84), ``n`` local north-east-down at the current position,
    ``b`` body forward-right-down.
Names
    A vector ends with its frame: ``f_b``, ``v_n``. A rotation names both: ``C_nb`` and ``q_nb`` take
    components in b to components in n, ``x_n = C_nb @ x_b``. Quaternions are scalar first, ``[w, x, y, z]``,
    unit norm. Euler angles are heading, pitch, roll in the aerospace sequence z-y-x.
Units
    SI and radians everywhere inside. Degrees, feet, knots, g and deg/h live at the edges only and always
    carry a unit suffix: ``heading_deg``, ``gyro_bias_degph``, ``accel_bias_mg``. Latitude and longitude are
    geodetic, WGS84, in radians; height ``h`` is above the ellipsoid, in metres, positive up.
Signs of errors
    Error = estimate - truth. Attitude error ``phi`` is a small rotation in n with
    ``C_nb_hat = (I - [phi x]) C_nb``. Position error is in metres, north-east-down.
    A sensor bias adds to the truth: ``omega_measured = omega + b_g``, ``f_measured = f + b_a``;
    bias error = estimated bias - true bias.
Time
    Seconds from the start of the run (float64). Sampling is counted in integer ticks of the base rate.
    An increment stamped ``t`` covers the interval that ends at ``t``.
State layout
    Written once, in `nav.error_model`; everything else uses its named slices.

Nothing here imports the simulator: an estimator that could see truth would prove nothing.
"""
