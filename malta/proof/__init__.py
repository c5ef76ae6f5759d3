"""Proofs: margins and worst-case gains of loops with uncertain parameters, from matrices to a certificate.

A proof is read in this order: groups (the closed loop, split into groups of states that close loops by themselves) ->
polynomial (their characteristic polynomials over a box) -> exclusion (no zero at any frequency) -> robust (the margin).

uncertain, systems, box   what a user asks about: systems, compensators, ranges
robust, search            the margin: witness, proof, certificate
machine                   a machine's model in its parameters
polynomial                characteristic polynomials over boxes
exclusion                 branch and bound over frequency and box; witnesses; Hurwitz's determinants
multipliers               many parameters: pencils and multipliers
weak_coupling             held currents anywhere in the travel: coupled axes
blocks                    unmodelled dynamics and worst-case gains
certificate               the proof as a file, and the checker of its own
"""
