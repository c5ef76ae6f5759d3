"""The JSON documents that commands print with --json: a model of each, and the functions that fill it.

Keys are identifiers. Numbers are in SI, and a key ends in the unit: `rise_s`, `phase_rad`, and `overshoot_share`, where
0.01 is 1 %. Where a unit depends on the machine, it stands beside the number as `unit`. A number that is not finite
is null.
"""
