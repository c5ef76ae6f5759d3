"""Robust stability and worst-case gain, proven: from matrices with parameters to a margin and its certificate.

expressions                   CasADi functions, evaluated in exact, ball and polynomial arithmetic
groups                        the closed loop -> groups of states that close loops by themselves
characteristic                the characteristic polynomial a(s; p) of a group
family, families              a(s; p) over a box: Bernstein polynomials in p and a radius for each coefficient
exclusion                     branch and bound: no a(jw; p) = 0 for any w on the box
witness, descent              the nearest p at which a(jw; p) = 0
search, robust                the margin
held_currents, weak_coupling  machines with held currents anywhere in their travel: coupled axes
taylor, laurent               expressions of p and a position, enclosed over an interval of positions
loops, responses, classical   the sampled loop of a machine, its frequency responses, disk and delay margins
travel, stages, verify        margins over the travel, stage by stage; poles, peaks and bandwidths
"""
