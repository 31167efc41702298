"""What a run is made of: the reference motion, increments and samples.

`feed` is what every feed gives, `simulated` a motion with sensors, `closed` one whose motion follows an estimate by the
`autopilot`; `known` what estimators are told of the motion. `build.open_feed` chooses.
"""
