"""Robust stability and worst-case gain, proven: from matrices with parameters to a margin and its certificate.

expressions    CasADi functions, evaluated in exact, ball and polynomial arithmetic
characteristic the closed loop -> groups, each with its characteristic polynomial a(s; p)
family         a(s; p) over a box: Bernstein polynomials in p and a radius for each coefficient
exclusion      branch and bound: no a(jw; p) = 0 for any w on the box
witness        the nearest p at which a(jw; p) = 0
robust         the margin
held, weak     machines with held currents anywhere in their travel: axes by themselves, their coupling bounded
taylor, along  expressions of p and a position, enclosed over an interval of positions
"""
