"""One netCDF-4 file per run, written as it goes, and what it is exported to."""
