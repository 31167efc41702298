"""How many examples the tests draw that draw some: `make test` and CI the same every time, `make test-all` new ones."""

from hypothesis import settings

settings.register_profile("test", derandomize=True, deadline=None, max_examples=50)
settings.register_profile("ci", derandomize=True, deadline=None, max_examples=400)
settings.register_profile("all", deadline=None, max_examples=400, print_blob=True)
settings.load_profile("test")
