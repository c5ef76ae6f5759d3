"""Machines with held currents anywhere in their travel: each axis alone, and a bound of what couples them."""
