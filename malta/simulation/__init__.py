"""Nonlinear simulation: the control period as one function, its engines, scenarios, experiments."""
