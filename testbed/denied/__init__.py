"""The benchmark of denied navigation: ``testbed denied``, for our filters and for anybody's.

GNSS is lost, and for half an hour an aircraft circles without it. How far off is the estimate after 60, 120, 600 and
1800 s, how honest is what it claims, and how near is it to the posterior Cramér-Rao bound of its sensors? The table is
of every weather, set of aids and grade of the IMU (`testbed.denied.table`, a line each).

The motion does not depend on sensors or filters, so that one flight a weather, draw and route serves all sets of aids
there, all grades and all estimators (`testbed.denied.flight`); flights are what is worked off in parallel and kept
(`testbed.denied.benchmark`). Statistics, tables and the figure are in `testbed.report.denied`: they change no number of
a flight, so that a folder of flights outlives a change to them. It is a room beside `testbed.papers`, and not one file
in `testbed.many`, since it is a benchmark with weather, aids and goals of its own that uses what is there.
"""
