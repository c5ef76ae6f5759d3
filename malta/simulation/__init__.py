"""Nonlinear simulation: control period, engines, scenarios, batches and experiments.

layout, current_control, substep, period    one control period of machine and controller as CasADi functions
instructions, translate, compiled, engines  these functions as C, or on CasADi's virtual machine
scenario, references, noise, inputs         the reference, and everything that disturbs the machine
simulate, verdict, trajectory, start_up     one machine, with all time series
batch, digest                               thousands of machines, with the figures of each run
experiments, generic, responses             scenarios with figures of merit
time_optimal, inverter                      the fastest stroke, and half-bridges on a DC link
"""
