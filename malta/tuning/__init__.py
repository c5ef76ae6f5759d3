"""Search for weights or PID gains that meet a specification."""
