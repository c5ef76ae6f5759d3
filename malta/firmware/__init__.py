"""Firmware: the control law as C that computes the same bits on every processor, its tests, and FMUs."""
