"""The engine of simulations: control periods as C or in CasADi, many machines at once.

integration_state       what is proven to be conserved or linear, and steps that make use of it
instructions, engines   the functions of the period as C, or in CasADi's virtual machine
compiled                libraries of C
batch, digest           thousands of machines, with the figures of each run
"""
