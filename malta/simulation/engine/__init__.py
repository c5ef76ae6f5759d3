"""The engine of simulations: control periods as C or in CasADi, many machines at once."""
