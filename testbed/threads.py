"""How many threads linear algebra may have: one, as more take longer at matrices as small as these are."""

from __future__ import annotations

from collections.abc import Mapping

# Of the environment, read by the libraries as they are loaded.
ONE: Mapping[str, str] = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
