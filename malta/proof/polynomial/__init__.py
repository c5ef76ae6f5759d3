"""Characteristic polynomials over boxes of parameters: exact, in balls, bounded and enclosed."""
