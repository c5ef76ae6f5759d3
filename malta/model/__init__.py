"""Machines as records: parameters, plants in CasADi, rigid bodies, linearization, signals and units."""
