"""The ledger: every number that a source paper publishes, ours for each design, and a verdict. Computed, not typed.

Published numbers are read from data/published/. Ours come from the same functions that a user calls: model, gains,
margins, and the experiments on the simulated machine. A verdict follows from the numbers, by one rule for all papers:

    A figure agrees with the printed one when they differ by no more than half a unit of the last printed digit, or,
    where ours is one of chance, by its interval besides. Where the paper says "about", around or approximately
    (`about = true` beside its figure in data/published/), they may differ by 5 % of it. A bound has to be kept by
    every digit of ours, too.

    reproduced          ours agrees
    smaller, x 19       a bound is kept, and ours is 19 times smaller than the bound; "larger" likewise
    within x %          of the published figure, x up to 20, with the reason
    by construction     agrees, and could not differ: the row restates an input, or what the design was solved for
    not compared        ours is of something else: another method, or another computer
    not reproduced      else, with the reason

Only designs that are meant to reproduce the paper are judged, and any design on a row of the machine alone or of an
input; the figures of other designs stand there without a verdict. Where the designs differ, each has its verdict; where
the paper leaves a definition open, the verdict names the one that we use. Each claim has one word as well, for a line
of a terminal: see WORDS. The claims on a machine are in the module `claims` of its package here, which has

    SOURCE        the paper
    REPRODUCING   names of the designs that are meant to reproduce it; without it all are
    evidence      (spec, published, progress) -> Evidence of a design, with all that the rows need besides
    rows          () -> list[Row]
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar

from malta import InputError, Spec, experiment, linearize, synthesize, verify
from malta.bound import at_least
from malta.margins import LoopReport
from malta.margins.loop_report import ZONES
from malta.model import LinearModel, in_unit
from malta.model.parts import require_part
from malta.model.printed import PublishedFigure, half_of_last_digit, published_figure
from malta.proof import Margin
from malta.report.ledger import Ledger, LedgerClaim, Word
from malta.simulation import Experiment
from malta.simulation.experiments import Progress, progress_of_part
from malta.synthesis import Controller
from malta.work import is_stopped, share_time

ABOUT_TOLERANCE, WITHIN_SHARE = 0.05, 0.2  # largest relative differences from an "about", and "within x %"
# In front of a factor from a bound, below which one it has two decimals, and the largest one that is shown.
FACTOR, FACTOR_LIMIT, MAX_FACTOR = ", x ", 1.1, 1000.0
ROUNDING = 1e-9
EVIDENCE_SHARE = 0.5  # of the time, for what all rows need; the rest is for the rows
Result = TypeVar("Result")
OTHER_DESIGN_NOTE = "of another design"  # no design of the ledger is meant to reproduce the row
LQG_NOTE = "of an LQG only"
# Words of claims and the beginnings of verdicts that they stand for, the first that counts first; see word_of.
WORDS: dict[Word, tuple[str, ...]] = {
    "differs": ("not reproduced",),
    "near": ("within",),
    "kept": ("smaller", "larger", "on the other side", "other than"),
    "reproduced": ("reproduced",),
    "input": ("by construction",),
    "beside": ("not compared",),
}
ZONE_NOTE = f"ISO 14839-3 zone {ZONES[0][1]} ends at {ZONES[0][0]:g}"


class Evidence(Protocol):
    """A design, its margins and its experiments; a machine's own record may have more fields."""

    @property
    def spec(self) -> Spec: ...
    @property
    def controller(self) -> Controller: ...
    @property
    def margins(self) -> LoopReport: ...
    @property
    def experiments(self) -> Mapping[str, Experiment]: ...


class DesignRuns(NamedTuple):
    """A design and the experiments that claims are about."""

    model: LinearModel
    controller: Controller
    margins: LoopReport
    experiments: dict[str, Experiment]


def run_design(spec: Spec, names: Sequence[str], progress: Progress | None, **options: Any) -> DesignRuns:
    """Design a controller, prove its margins, and run the experiments of these names.

    progress : called with the share that is done
    options : of every experiment
    """
    plant = spec.plant
    model = linearize(plant, plant.at(**spec.operating_point))
    controller = synthesize(spec, model, solver="scipy")
    parts = [progress_of_part(progress, n, len(names)) for n in range(len(names))]
    experiments = {
        name: experiment(name, plant, controller, progress=part, **options)
        for name, part in zip(names, parts, strict=True)
    }
    return DesignRuns(model, controller, verify(model, controller, spec.uncertainty), experiments)


class Chance(float):
    """A figure of chance: a float with half of its 95 % interval, SI, which is shown behind it.

    >>> Chance(0.14, 0.01).half
    0.01
    """

    half: float

    def __new__(cls, value: float, half: float) -> Chance:
        figure = super().__new__(cls, value)
        figure.half = half
        return figure


class Row(NamedTuple):
    """A figure that the paper publishes, and the function of a design's evidence that computes ours."""

    subject: str
    shown: str  # form and unit of both figures: "{:.2f} mm", "{:.1f}" of a number; or "proven percent"
    value: Callable[[Any], float]  # of the machine's evidence; SI
    # key of data/published/, or a figure that the text implies, with the digits of `shown`; None: ours
    published: str | float | None = None
    relation: str = "equal"  # or a bound, "at most" or "at least"; "beside": not compared
    note: str = ""  # where the paper leaves a definition open, or what explains the figures
    why: str = ""  # the reason why a figure differs
    of_lqg: bool = False  # a PID has no such figure: it shows a dash, and no verdict
    # Whether the figure restates an input, or what a design was solved for; of the machine's evidence.
    by_construction: bool | Callable[[Any], bool] = False
    of_machine: bool = False  # no design changes the figure: any is judged
    designs: tuple[str, ...] = ()  # that are meant to reproduce the row, where it is not REPRODUCING

    @property
    def form(self) -> str:
        """The format of a figure in its unit."""
        return self.shown.partition(" ")[0]

    @property
    def unit(self) -> str:
        """The unit of both figures; "1" for a number."""
        return self.shown.partition(" ")[2] or "1"


def compute_ledger(
    specs: Sequence[Spec], published: Mapping[str, Any], progress: Progress | None = None
) -> Ledger:
    """What `malta.ledger` computes."""
    if not specs:
        raise InputError("claims", "designs", "none", "at least one design")
    machine = specs[0].plant.name
    for spec in specs:
        if spec.plant.name != machine:
            raise InputError(spec.path, "machine", spec.plant.name, f"{machine}, as of {specs[0].path}")
    paper = require_part("claims", machine)
    found, claims, rows = list[Evidence](), list[LedgerClaim](), paper.rows()
    with share_time(EVIDENCE_SHARE):
        for n, spec in enumerate(specs):
            part = progress_of_part(progress, n, len(specs))
            evidence = _whole(partial(paper.evidence, spec, published, part))
            found += [] if evidence is None else [evidence]
    names = tuple(e.spec.name for e in found)
    meant = tuple(name for name in names if name in getattr(paper, "REPRODUCING", names))
    for row in rows if found else ():
        claim = _whole(partial(claim_of, row, found, published, meant))
        claims += [] if claim is None else [claim]
    return Ledger(machine, paper.SOURCE, names, tuple(claims), meant, len(rows) - len(claims))


def _whole(compute: Callable[[], Result]) -> Result | None:
    """What is computed; None where the clock ended it: of runs and proofs that are cut no claim is made."""
    found = None
    try:
        found = None if is_stopped() else compute()
    except (Exception, KeyboardInterrupt):  # whatever comes of figures of cut runs
        if not is_stopped():
            raise
    return None if is_stopped() else found


def claim_of(
    row: Row, found: Sequence[Evidence], published: Mapping[str, Any], reproducing: Sequence[str]
) -> LedgerClaim:
    """The line of the ledger for a row and the evidence of all designs.

    reproducing : names of the designs that are meant to reproduce the paper
    """
    shown = [e for e in found if not row.of_lqg or e.spec.kind == "LQG"]
    figures = [row.value(e) if e in shown else math.nan for e in found]
    ours = tuple(_show_figure(row, figure) for figure in figures)
    unit = {"1": "", "percent": " [%]", "um": " [µm]", "urad": " [µrad]", "deg": " [°]"}.get(
        row.unit, f" [{row.unit}]"
    )
    subject = row.subject + unit
    if row.published is None:
        return LedgerClaim(subject, "–", ours, "ours" + (f": {row.note}" if row.note else ""), "ours")
    target, printed = _print_published(row, published)
    judged = [e for e in shown if _is_judged(row, e.spec.name, reproducing)]
    if not judged:
        note = f"; {row.note}" if row.note and shown else ""
        return LedgerClaim(subject, printed, ours, (OTHER_DESIGN_NOTE if shown else LQG_NOTE) + note, "other")
    own = [_in_unit(figure, row.unit) for figure, e in zip(figures, found, strict=True) if e in judged]
    built = [row.by_construction(e) if callable(row.by_construction) else row.by_construction for e in judged]
    words = [
        verdict_word(row, target, value, by_construction=one) for value, one in zip(own, built, strict=True)
    ]
    verdict = verdict_of(row, words, [e.spec.name for e in judged])
    return LedgerClaim(subject, printed, ours, verdict, word_of(words))


def _print_published(row: Row, published: Mapping[str, Any]) -> tuple[PublishedFigure, str]:
    """What the paper prints, or what the row says that its text implies, in the row's unit; and shown so."""
    if isinstance(row.published, str):
        value, half, about = published_figure(published, row.published)
        figure = PublishedFigure(in_unit(value, row.unit), in_unit(half, row.unit), about)
    else:
        assert row.published is not None
        target = in_unit(row.published, row.unit)
        number = re.search(r"-?[\d.]+(?:e[-+]\d+)?", row.form.format(target))  # "proven" has none
        figure = PublishedFigure(target, half_of_last_digit(number[0] if number else f"{target:g}"))
    sign = "±" if row.form.startswith("±") else "≈ " if figure.about else ""
    mark = {"at most": "≤ ", "at least": "≥ "}.get(row.relation, sign)
    return figure, f"{mark}{figure.value:.{max(0, round(-math.log10(2 * figure.half)))}f}"


def _in_unit(figure: float, unit: str) -> float:
    """A figure in a unit, with its interval if it is one of chance."""
    value = in_unit(figure, unit)
    return Chance(value, in_unit(figure.half, unit)) if isinstance(figure, Chance) else value


def _show_figure(row: Row, figure: float) -> str:
    """A figure in the row's form, with its interval if it is one of chance; "–" for none."""
    if math.isnan(figure):
        return "–"
    if row.form == "proven":
        return at_least(figure).percent(unit="")
    value = _in_unit(figure, row.unit)
    text = row.form.format(value)
    return f"{text} ±{row.form.format(value.half)}" if isinstance(value, Chance) else text


def _is_judged(row: Row, name: str, reproducing: Sequence[str]) -> bool:
    """Whether a design is meant to reproduce a row; of the machine alone, of an input and beside it every design is."""
    if row.of_machine or row.by_construction is True or row.relation == "beside":
        return True
    return name in (row.designs or reproducing)


def word_of(verdicts: Sequence[str]) -> Word:
    """The one word of a claim, a key of WORDS or "partly", from the verdicts on the designs that are judged.

    >>> word_of(["within 7 %"]), word_of(["reproduced", "not reproduced: larger, x 3.1"])
    ('near', 'partly')
    """
    words = {next(w for w, begins in WORDS.items() if verdict.startswith(begins)) for verdict in verdicts}
    return "partly" if "differs" in words and len(words) > 1 else next(w for w in WORDS if w in words)


def verdict_of(row: Row, words: Sequence[str], names: Sequence[str]) -> str:
    """The verdict on the figures of all designs that are judged, from that on each, with notes and reasons."""
    differs = any("not reproduced" in word or "within" in word for word in words)
    said = dict.fromkeys((row.note, row.why if differs else ""))  # each once
    note = "".join(f"; {text}" for text in said if text)
    kinds = {word.partition(FACTOR)[0] for word in words}
    if len(set(words)) == 1:
        return words[0] + note
    if len(kinds) == 1 and all(FACTOR in word for word in words):
        return kinds.pop() + "".join(FACTOR + word.partition(FACTOR)[2] for word in words) + note
    return "; ".join(f"{name}: {word}" for name, word in zip(names, words, strict=True)) + note


def verdict_word(row: Row, target: PublishedFigure, value: float, *, by_construction: bool = False) -> str:
    """The verdict on the figure of one design, both in the row's unit."""
    word = _comparison(row, target, value)
    if not by_construction or word.startswith("not"):
        return word
    return f"by construction, {word}" if word.endswith("%") else "by construction"


def _comparison(row: Row, target: PublishedFigure, value: float) -> str:
    """What the numbers say, wherever the figure comes from."""
    if row.relation == "beside":
        return "not compared"
    if math.isnan(value):
        return "not reproduced"
    bound, bounded = target.value, row.relation in ("at most", "at least")
    if bounded and not (value <= bound if row.relation == "at most" else value >= bound):
        return f"not reproduced: {_distance(bound, value)}"
    if is_reproduced(target, value):
        return "reproduced"
    if bounded:
        return _distance(bound, value)
    off = abs(value / bound - 1) if bound else math.inf
    return (
        f"within {math.ceil((off - ROUNDING) * 100)} %"
        if off <= WITHIN_SHARE + ROUNDING
        else "not reproduced"
    )


def is_reproduced(target: PublishedFigure, value: float) -> bool:
    """Whether a figure agrees with the published one: the rule of this module.

    >>> is_reproduced(PublishedFigure(25.67, 0.005), 24.70), is_reproduced(PublishedFigure(25.0, 0.5, True), 24.0)
    (False, True)
    """
    half = max(target.half, ABOUT_TOLERANCE * abs(target.value) if target.about else 0.0)
    if isinstance(value, Chance):
        half += value.half
    return abs(value - target.value) <= half + ROUNDING * abs(target.value)


def _distance(bound: float, value: float) -> str:
    """How far a figure is from its bound, in size.

    >>> _distance(0.83, 0.043), _distance(4.0, 4.02)
    ('smaller, x 19', 'larger, x 1.01')
    """
    if bound == 0 or (value != 0 and (value < 0) != (bound < 0)):  # a product may underflow
        return "on the other side of zero" if bound else "other than zero"
    ratio = abs(value / bound)
    size = max(ratio, 1 / ratio) if ratio else math.inf
    shown = f"> {MAX_FACTOR:.0f}" if size > MAX_FACTOR else f"{size:.0f}" if size >= 10 else f"{size:.1f}"
    if size < FACTOR_LIMIT:  # "x 1.0" would say nothing
        shown = f"{math.ceil(100 * size - ROUNDING) / 100:.2f}"
    return f"{'larger' if ratio > 1 else 'smaller'}{FACTOR}{shown}"


def machine_share(e: Evidence) -> float:
    """The proven margin of the machine's own loop, as a share of the design's uncertainty; NaN without a proof."""
    return math.nan if e.margins.robust is None else proven_share(e.margins.robust)


def proven_share(margin: Margin) -> float:
    """The proven lower bound of a margin; NaN where nothing is proven."""
    return math.nan if margin.lower is None else margin.lower


def bandwidth(definition: str, e: Evidence) -> float:
    """The bandwidth by one of the definitions in BANDWIDTHS, rad/s."""
    return e.margins.bandwidth[definition]


def peak_sensitivity(e: Evidence) -> float:
    """The largest peak sensitivity of all sensors."""
    return max(v for name, v in e.margins.peak_sensitivity.items() if name != "sigma_max")


def merit(name: str, label: str, e: Evidence) -> float:
    """A figure of merit of an experiment, by its label; SI."""
    return next(merit.value for merit in e.experiments[name].merits if merit.label == label)


def case_merit(name: str, case: int | str, figure: int | str, e: Evidence) -> float:
    """A figure of merit of one case of an experiment; case and figure are named by number or by label."""
    cases = e.experiments[name].cases
    chosen = cases[case] if isinstance(case, int) else next(one for one in cases if one.label == case)
    if isinstance(figure, int):
        return chosen.merits[figure].value
    return next(one.value for one in chosen.merits if one.label == figure)


# The ledger in a Markdown file: its tables are computed anew where they stand, and nothing else changes.
#
#     ### tubular, S. Miric et al., ...          the machine and its paper: the title of a ledger (or with ##)
#
#     | claim | published | `table2` | ... | verdict |       the designs are those that the header names
#
# A count in a summary in front of the table, as "<summary>52 figures", follows the table.


HEADER = re.compile(r"^\| claim \| published \|(?P<designs>.*)\| verdict \|\n", re.MULTILINE)
TITLE = re.compile(r"^###? (?P<machine>\w+), .*\n", re.MULTILINE)
COUNT = re.compile(r"(?<=<summary>)\d+(?= figures)")


class ClaimsPlace(NamedTuple):
    """A table of claims in a text: from `begin`, the end of its title, and `start` to `end`."""

    machine: str
    designs: tuple[str, ...]
    begin: int
    start: int
    end: int


def find_tables(text: str, name: str) -> list[ClaimsPlace]:
    """Find the tables of claims in a text. Raises InputError, naming the file, where there is none."""
    places, titles = [], list(TITLE.finditer(text))
    for header in HEADER.finditer(text):
        above = [title for title in titles if title.end() <= header.start()]
        if not above:
            raise InputError(name, "claims", "a table without a title", '"### MACHINE, SOURCE" above it')
        rest = re.compile(r"(?:\|.*\n)+").match(text, header.start())
        assert rest is not None  # the header is such a line
        designs = tuple(re.findall(r"`(\w+)`", header["designs"]))
        places.append(ClaimsPlace(above[-1]["machine"], designs, above[-1].end(), header.start(), rest.end()))
    if not places:
        raise InputError(name, "claims", "no table", 'a line "| claim | published | `DESIGN` | verdict |"')
    return places


def replace_tables(text: str, ledgers: Sequence[Ledger], name: str) -> str:
    """Put the ledgers, in the order of `find_tables`, in the places of a text's tables."""
    for place, ledger in reversed(list(zip(find_tables(text, name), ledgers, strict=True))):
        between = COUNT.sub(f"{len(ledger.claims)}", text[place.begin : place.start])
        text = text[: place.begin] + between + ledger.markdown() + text[place.end :]
    return text
