"""Sigma points instead of derivatives: the engine for attitude errors that are too large to be linear.

The error state and its signs are those of `nav.error_model`; the attitude's part is a rotation vector,
``C_nb_hat = exp(-[phi x]) C_nb``, of any size. A local filter keeps its strapdown, its estimated values and P, and

* in place of `kalman.predict` calls `predict`, and takes the mean error that it returns out of the motion;
* in place of `kalman.innovate` and `kalman.correct` calls `points`, its measurement function, `innovate` and
  `correct` (`update` does all four), or stays with the linear ones for a measurement that is linear in the error.

Transform. With P = L L' and L_j the columns of L, the points are ``e = 0`` and ``e = +-s L_j``, s = alpha sqrt(3): the
scaled transform with kappa = 0 over the three directions in which the equations curve, all others being linear. From
Y_j+-, the points after the function, with ``a_j = (Y_j+ - Y_j-) / (2 s)``, ``b_j = (Y_j+ + Y_j-) / 2 - Y_0`` and
``c = sum b_j / s^2``,

    mean = Y_0 + c
    covariance = sum a_j a_j' + sum b_j b_j' / s^2 + (beta - alpha^2) c c'

which are the weighted sums of Julier and Uhlmann (Proc. IEEE 92, 2004, 401) rearranged so that no weight is negative:
it is positive for alpha^2 <= beta whatever the function. A function that curves in more directions than three gets the
transform with n + kappa = 3.

Measurement. Along all directions but those three it is linear, so that neither the rest of L nor a Jacobian in the
attitude is needed: P, less what the three columns have of it, gives the covariance with the measurement there.

Time update. Only the attitude is bent by the motion, so only the three columns of L that move it need a function; all
else the linear step carries. Their function is the error model for large misalignment
(Cheng et al. 2020, Eq 1, with the accelerometers' term that its print leaves out); E = exp(-[phi x]), and the
quantities with a hat are those of the strapdown:

    phi' = -[w_in_hat x] phi + J_r^-1(phi) C_nb_hat db_g + J_l^-1(phi) dw_in
    dv'  = (I - E^-1) C_nb_hat f_hat - E^-1 C_nb_hat db_a + (linear terms of `error_model`)

`predict` takes of it what the transition leaves out, so for small errors it is the linear step. No point needs a
strapdown of its own (the tests compare with points that have one).
"""

from nav.unscented.measurement import correct, innovate, update
from nav.unscented.sigma_points import (
    CURVED,
    FURTHER,
    Points,
    Scaling,
    factor,
    factor_into,
    points,
    points_into,
    remove,
    scratch,
)
from nav.unscented.time_update import carry, predict

__all__ = [
    "CURVED",
    "FURTHER",
    "Points",
    "Scaling",
    "carry",
    "correct",
    "factor",
    "factor_into",
    "innovate",
    "points",
    "points_into",
    "predict",
    "remove",
    "scratch",
    "update",
]
