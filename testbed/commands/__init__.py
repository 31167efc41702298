"""Commands of more than a screen, and what commands share; `testbed.__main__` has the others."""
