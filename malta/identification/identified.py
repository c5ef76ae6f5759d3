"""What was identified from a log: parameters with conditional and total intervals, and whether to believe them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv

from malta.display import Description, display, quantity
from malta.identification.response import units_of_model
from malta.identification.spectra import SIGMA, Explained, sentence_of

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.identification.checks import LoopCheck
    from malta.identification.explanation import Explanation
    from malta.identification.log import Log
    from malta.identification.prediction import Predicted
    from malta.identification.record_fit import RecordFit
    from malta.identification.unmodelled import Unmodelled
    from malta.model.plant import Plant

MAX_LINE_CORRELATION = 5.0  # standard deviations of the correlation between neighbouring lines
MAX_ESTIMATE_DISTANCE = 3.0  # standard deviations between the estimates at the lines and in time
ESTIMATE_ACCURACY = 3e-5  # of a value: to which estimates on a right model are computed
MAX_LEFT = 0.02  # of the response at the lines, that neither parameters nor imperfections explain
MAX_WIDTHS = 3.0  # times its conditional interval, that a total one may be by what nothing explains
MAX_TOTAL = 0.02  # of its value, that it may be in any case


@display
@dataclass(frozen=True, eq=False)
class Identified:
    """Parameters that were identified from a log.

    Two intervals belong to each of them: the conditional one, of noise alone with everything else exactly as it was
    taken, and the total one, with everything else as uncertain as it is.

    log : from which
    plant : the machine with these parameters
    names : of the parameters
    values : SI
    start : SI, with which the search began: those of the gain file
    covariance : of the values by noise alone, SI
    held : parameters that act too and were taken as known, SI
    chi2 : of the residuals at the lines over their degrees of freedom; 1 where the model is right
    limit : of chi2 over its degrees of freedom, above which the model is refused
    dof : degrees of freedom
    whiteness : correlation of neighbouring lines' residuals in standard deviations
    distortion : power at multiples of 1 / period that were not excited, over the noise; 1 of a linear machine
    by_output : chi2 of each output
    dropped : parameters that this log does not determine by themselves, with their standard deviation as a share
    in_time : the same parameters from prediction errors in time; None where the machine's sensors lag, or its states
        are not (q, q')
    explained : where chi2 is above its limit: what a change of each parameter that was taken as known would explain, as
        shares of its value and of chi2
    explanation : the parameters with everything else uncertain, and what explains the log beside them
    loop : the identified machine under the law, beside the loop as the log has it; None: the log tells no S
    outside : why a parameter is outside of the gain file's box; "": none is
    record : of prediction errors alone, without lines of an excitation: what is left in them
    unmodelled : what the machine with these parameters alone leaves, as a bound of dynamics that it lacks; None without
        lines

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> loop = malta.loop(plant, controller)
    >>> plan = malta.excite(loop, period=0.5, periods=4, band=(4, 400))
    >>> true = plant.variant(dataclasses.replace(plant.parameters, K_A=9000.0))
    >>> excited = malta.Scenario.excited(plan.signal, plan.duration)
    >>> run = malta.simulate(true, controller, excited)
    >>> found = malta.identify(
    ...     controller, malta.identification.log_of(run), parameters=["K_A", "K_B"]
    ... )
    >>> found.names, len(found.intervals["K_A"])
    (('K_A', 'K_B'), 2)
    """

    log: Log
    plant: Plant
    names: tuple[str, ...]
    values: FloatArray
    start: FloatArray
    covariance: FloatArray
    held: Mapping[str, float]
    chi2: float
    limit: float
    dof: int
    whiteness: float
    distortion: float
    by_output: Mapping[str, float]
    dropped: Mapping[str, float]
    in_time: Predicted | None = None
    explained: Explained = field(default_factory=dict)
    explanation: Explanation | None = None
    loop: LoopCheck | None = None
    outside: str = ""
    record: RecordFit | None = None
    unmodelled: Unmodelled | None = None

    @property
    def half_widths(self) -> FloatArray:
        """Half of each conditional 95 % interval, of noise alone, SI."""
        return np.asarray(SIGMA * np.sqrt(np.diag(self.covariance)))

    @property
    def total_covariance(self) -> FloatArray:
        """Mean squares of the values' errors, with everything else as uncertain as it is, SI.

        Where the values are those of a fit without imperfections, their distance to the most likely ones counts.
        """
        if self.explanation is None:
            return self.covariance
        off = self.values - self.explanation.values
        return np.asarray(self.explanation.covariance + np.outer(off, off))

    @property
    def total(self) -> FloatArray:
        """Half of each total 95 % interval, SI: never narrower than the conditional one."""
        return np.maximum(SIGMA * np.sqrt(np.diag(self.total_covariance)), self.half_widths)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The total 95 % interval of each parameter, SI."""
        low, high = self.values - self.total, self.values + self.total
        return dict(zip(self.names, zip(low.tolist(), high.tolist(), strict=True), strict=True))

    @property
    def correlation(self) -> FloatArray:
        """Of the errors of the values."""
        sigma = np.sqrt(np.diag(self.total_covariance))
        return np.asarray(self.total_covariance / np.outer(sigma, sigma))

    @property
    def joint(self) -> float:
        """By how much the box of the intervals grows until it holds the 95 % ellipsoid of all parameters together."""
        return float(np.sqrt(2 * gammaincinv(len(self.names) / 2, 0.95)) / SIGMA)

    @property
    def differences(self) -> dict[str, float]:
        """By parameter: the estimate in time less that at the lines, in standard deviations of the larger one.

        Both use the same readings, so that right models differ by much less than the deviation of either. What either
        computes to counts as a deviation too: a part of the curvature, and of motion between samples, is left.
        """
        if self.in_time is None:
            return {}
        variance = np.maximum(np.diag(self.covariance), np.diag(self.in_time.covariance))
        off = (self.in_time.values - self.values) / np.sqrt(variance + (ESTIMATE_ACCURACY * self.values) ** 2)
        return dict(zip(self.names, off.tolist(), strict=True))

    @property
    def refusal(self) -> str:
        """Why the model does not explain the log; "": it does."""
        if self.record is not None:
            return self.record.refusal
        if self.chi2 > self.limit and (unexplained := self._unexplained):
            return unexplained
        if self.outside:
            return self.outside
        if self.loop is not None and self.loop.refusal:
            return self.loop.refusal
        if self.chi2 > self.limit:
            return ""
        if abs(self.whiteness) > MAX_LINE_CORRELATION:
            return (
                f"residuals of neighbouring lines are correlated by {self.whiteness:.1f} standard deviations, at "
                f"most {MAX_LINE_CORRELATION:g} is noise: the machine's model lacks something"
            )
        if self.differences and self.in_time is not None:
            name, off = max(self.differences.items(), key=lambda item: abs(item[1]))
            k = self.names.index(name)
            if abs(off) > MAX_ESTIMATE_DISTANCE:
                return (
                    f"{name} is {self.values[k]:.5g} at the lines and {self.in_time.values[k]:.5g} in time, "
                    f"{abs(off):.1f} standard deviations apart, at most {MAX_ESTIMATE_DISTANCE:g} is noise: the model "
                    "lacks something"
                )
        return ""

    @property
    def verdict(self) -> str:
        """Whether the log identifies the machine, in a sentence."""
        if self.refusal:
            return "not identified"
        if self.record is not None:
            return "identified from prediction errors alone, with everything else as it was taken"
        e = self.explanation
        if e is None or self.chi2 <= self.limit:
            found = "identified: the parameters explain the log to its noise"
        else:
            to = f"to {100 * e.share:.2g} % of the response" if e.share else "to its noise"
            names = ", ".join(f"{c.name} {quantity(c.value, c.unit)}" for c in e.causes)
            found = f"identified: the parameters and {names or 'small imperfections'} explain the log {to}"
        if self.loop is None:
            return f"{found}; its S was not measured"
        worst = f"{100 * self.loop.error:.2g} % beside the bands" if self.loop.error else "the bands"
        return f"{found}; |S| is measured as predicted, within {worst}"

    @property
    def _unexplained(self) -> str:
        """Why neither parameters nor imperfections explain the log; "": they do."""
        worst = max(self.by_output, key=lambda name: self.by_output[name])
        found = (
            f"chi2 / dof is {self.chi2:.3g}, at most {self.limit:.3g} is noise: the machine's model does not "
            f"explain the log, {worst} least ({self.by_output[worst]:.3g})"
        )
        e = self.explanation
        if e is None:
            return found + sentence_of(self.explained)
        if e.mistake:
            return f"{found}; {e.mistake}{sentence_of(self.explained)}"
        if e.share > MAX_LEFT:
            left = f"with all imperfections {100 * e.share:.2g} % of the response is left, at most {100 * MAX_LEFT:g} %"
            return f"{found}; {left}{sentence_of(self.explained)}"
        if e.chi2 > self.limit:
            for name, value, total, alone in zip(
                self.names, self.values, self.total, self.half_widths, strict=True
            ):
                if total > max(MAX_WIDTHS * alone, MAX_TOTAL * abs(value)):
                    return (
                        f"{found}; what no imperfection explains leaves {name} uncertain by "
                        f"{100 * total / abs(value):.2g} %"
                    )
        return ""

    @property
    def description(self) -> Description:
        """The values with their intervals, and how well they explain the log."""
        units = units_of_model(self.plant)
        rows = [
            (name, f"{value:.5g} +- {total:.2g} {units[name]}, by noise alone {half:.2g}")
            for name, value, total, half in zip(
                self.names, self.values, self.total, self.half_widths, strict=True
            )
        ]
        rows.append(("chi2 / dof", f"{self.chi2:.3f} of {self.dof}, at most {self.limit:.3f}"))
        return Description(f"Identified from {self.log.source!r}", tuple(rows))
