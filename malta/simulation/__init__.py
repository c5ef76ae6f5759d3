"""Nonlinear simulation: control period, engines, scenarios, batches and experiments.

layout, current_control, substep, period    one control period of machine and controller as CasADi functions
expressions, working                        what is proven to be conserved or linear, and steps that make use of it
instructions, once, translate               these functions as C
compiled, engines                           libraries of C, or CasADi's virtual machine
scenario, references, noise, inputs         the reference, and everything that disturbs the machine
prepared, simulate, verdict                 one machine
trajectory, start_up                        its time series, and its observer at the start
batch, workers, digest                      thousands of machines, with the figures of each run
experiments, generic, responses             scenarios with figures of merit
time_optimal, inverter                      the fastest stroke, and half-bridges on a DC link
"""
