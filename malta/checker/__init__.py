"""The checker of margin certificates: a folder that imports python-flint and nothing of malta.

Copy it, and run `python -m checker CERTIFICATE`. Read `check` first, then `loop` (whose polynomial) and `file` (what a
certificate has).
"""
