"""Estimators of a run: ours and anybody's. Each kind has its section of the scenario beside what builds it.

`datasheet` says what a filter is told of the sensors it is given, `lane` how an estimator is run, `custom` how a class
of the user's becomes one. A new built-in kind is one file here and one line in `registry`.
"""
