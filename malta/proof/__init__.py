"""Proofs: margins and worst-case gains of loops with uncertain parameters, from matrices to a certificate.

A proof is read in this order: groups (the closed loop, split into groups of states that close loops by themselves) ->
polynomial (their characteristic polynomials over a box) -> exclusion (no zero at any frequency) -> robust (the margin).

box                       what a user asks about, beside systems and compensators (linear/): ranges
connections               uncertain systems in series, in parallel, in feedback
robust, search            the margin: witness, proof, certificate
polynomial                characteristic polynomials over boxes
exclusion                 branch and bound over frequency and box; witnesses; Hurwitz's determinants
multipliers               many parameters: pencils and multipliers
weak_coupling             held currents anywhere in the travel: coupled axes
blocks                    unmodelled dynamics and worst-case gains
certificate               the proof as a file, for the folder malta/checker
"""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.budget import Budget as Budget
    from malta.linear.uncertain import Compensator as Compensator, UncertainSystem as UncertainSystem
    from malta.proof.blocks import Dynamic as Dynamic
    from malta.proof.blocks.gain import Gain as Gain
    from malta.proof.certificate import write_certificate as write_certificate
    from malta.proof.connections import (
        append as append,
        feedback as feedback,
        interconnect as interconnect,
        parallel as parallel,
        random_systems as random_systems,
        series as series,
    )
    from malta.proof.margin import Margin as Margin
    from malta.proof.polynomial_margin import margin_of_polynomial as margin_of_polynomial
    from malta.proof.rates import RateBound as RateBound, prove_rate as prove_rate
    from malta.proof.robust import Interrupted as Interrupted

_NAMES = {
    "malta.budget": "Budget",
    "malta.linear.uncertain": "Compensator UncertainSystem",
    "malta.proof.blocks": "Dynamic",
    "malta.proof.blocks.gain": "Gain",
    "malta.proof.certificate": "write_certificate",
    "malta.proof.connections": "append feedback interconnect parallel random_systems series",
    "malta.proof.margin": "Margin",
    "malta.proof.polynomial_margin": "margin_of_polynomial",
    "malta.proof.rates": "RateBound prove_rate",
    "malta.proof.robust": "Interrupted",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES, {"varying": "malta.proof.prove_rate"})
