"""The report of a gain file: its numbers are those of verify, and the page needs nothing else."""

from __future__ import annotations

import html as markup
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import control
import numpy as np
import pytest
from browsing import browser as browser, open_page, printed, printed_overlaps
from conftest import ROOT, Run
from page_checks import cells_of, read_page

import malta
from malta.bound import at_least
from malta.cli.report import campaigns_of, read_subject
from malta.loops.curves import loop_curves
from malta.margins.verify import linear_report
from malta.report.figures.drawing import STYLES, new_figure, printable
from malta.report.page.analysis import Subject, analyse, key_figures
from malta.report.page.document import Front, Page, dark_colour, pdf_of, render
from malta.report.page.report import page_of
from malta.report.page.sections import Illustration, PageTable, Section, pole_difference
from malta.report.verdict import SIGNS, verdict_lines

if TYPE_CHECKING:
    from malta.report.page.analysis import Analysis
    from malta.synthesis.controller import Controller

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

HOSTILE = '<script>alert("x")</script>$a_b$\\frac{\x0b'
# of a letter in a figure and of the page, as "rgb(0, 0, 0)"
COLOURS = """return [getComputedStyle(document.body).backgroundColor,
  ...[...document.querySelectorAll("svg text")].map(text => getComputedStyle(text).fill)]"""
# Labels of figures that a screen of this width does not show whole.
CUT = """return [...document.querySelectorAll("figure .scroll")].filter(box => box.scrollWidth > box.clientWidth)
  .map(box => box.getAttribute("aria-label"))"""
STRANGE = "é</svg>\"'&lt; ]]>"


def cart_controller(name: str = "cart design", base: float = 1e-4) -> Controller:
    """An LQG of a cart on a weak negative spring whose signals have names that no page may take for tags."""
    cart = malta.linear_machine(
        [[0, 1], [100, -0.1]], [[0], [2]], [[1, 0]],
        name="cart", states=["z [m]", "v [m/s]"], inputs=[f"{HOSTILE} [N]"], outputs=[f"{STRANGE} [m]"],
        noise=1e-6, nominal={"k": 1.0}, terms={"k": ([[0, 0], [50, 0]],)},
    )  # fmt: skip
    one = np.ones(1)
    weights = malta.synthesis.Weights(
        np.ones(2), np.array([base, 0.1]), one, one, one, np.array([base]), 1e-2 * one, 1e-12 * one
    )
    return malta.lqg(malta.linearize(cart, cart.at()), weights, 1e-3, name=name)


@pytest.fixture(scope="module")
def cart() -> Analysis:
    controller = cart_controller()
    return analyse(Subject(controller, controller.parameters, {"k": 0.2}), stages=False)


@pytest.fixture(scope="module")
def page(cart: Analysis) -> Page:
    return page_of(cart)


@pytest.mark.slow
def test_a_page_is_whole_in_itself_and_names_stay_text(page: Page) -> None:
    reader = read_page(page.html)
    text = "".join(reader.text)
    assert '<script>alert("x")</script>$a_b$\\frac{\ufffd' in text
    assert STRANGE in text
    assert reader.count["svg"] >= 7
    assert len(page.content) < 500_000


def test_the_key_figures_are_those_of_verify(cart: Analysis, page: Page) -> None:
    controller = cart.subject.controller
    margins = linear_report(cart.report.model, controller, {"k": 0.2})
    shown = {figure.label: figure.value for figure in key_figures(cart)}
    peak = max(value for name, value in margins.peak_sensitivity.items() if name != "sigma_max")
    assert margins.robust is not None
    assert margins.robust.lower is not None
    for line in verdict_lines(cart.report):
        assert markup.escape(f"{SIGNS[line.state]} {line.value}") in page.html
    assert shown["Bandwidth"] == f"{margins.bandwidth['sigma_max_T'] / (2 * np.pi):.1f} Hz"
    for value in shown.values():
        assert f'<dd class="value">{value}</dd>' in page.html
    found = {score.identifier: score.value for score in cart.figures}
    assert found["peak_sensitivity"] == peak
    assert found["bandwidth_sigma_max_T_rad_per_s"] == margins.bandwidth["sigma_max_T"]
    assert found["stable"] == 1.0


def test_the_gains_stand_in_the_page_to_six_digits(cart: Analysis, page: Page) -> None:
    K = cart.subject.controller.K
    (row,) = cells_of(page.html, "K<")[1:]
    assert [float(cell.replace("−", "-")) for cell in row[1:]] == pytest.approx(K[0], rel=1e-5)


X = np.geomspace(1.0, 1000.0, 400)


def curves_page() -> Page:
    """A page with a figure of two panels over one axis: logarithmic above, and of three decades either way below."""

    def draw() -> Any:
        figure = new_figure("curves", size=(7.0, 5.0))
        upper, lower = figure.subplots(2, 1, sharex=True)
        upper.loglog(X, X**2, label="square", **STYLES[0])
        upper.loglog(X, X**0.5, label="<root>", **STYLES[2])
        lower.plot(X, X - 100, **STYLES[0])
        lower.set_yscale("symlog", linthresh=10.0)
        lower.set_xlabel("frequency [rad/s]")
        upper.legend()
        return figure

    rows = PageTable("Numbers", ("a", "b"), (("1", "2"),), (False, True))
    return render(
        Front("Test", "Curves", "about"), [Section("one", "One", (Illustration(draw, "Curves."), rows))]
    )


def test_a_figure_says_what_its_panels_lines_and_legends_are() -> None:
    html = curves_page().html
    read_page(html)
    assert "<root>" not in html
    (told,) = json.loads(re.findall(r'id="panels-of-figures">(.*?)</script>', html, re.DOTALL)[0])
    assert [line["label"] for line in told["lines"]] == ["square", "<root>", "square"]  # the last by its look
    assert [entry["label"] for entry in told["legend"]] == ["square", "<root>"]
    for line, y in zip(told["lines"], (X**2, X**0.5), strict=False):
        path = re.findall(rf'id="{line["id"]}".*?d="(.*?)"', html, re.DOTALL)[0]
        (px, py), panel = map(float, re.findall(r"M ?(\S+) (\S+)", path)[0]), told["axes"][0]
        for at, ends, side, value in ((px, ("left", "right"), "x", X[0]), (py, ("bottom", "top"), "y", y[0])):
            share = (at - panel[ends[0]]) / (panel[ends[1]] - panel[ends[0]])
            low, high = (np.log10(panel[side][end]) for end in ("low", "high"))
            assert low + share * (high - low) == pytest.approx(np.log10(value), abs=0.01)


POINT = """
const [n, share, kind, down] = arguments, svg = document.querySelector("figure svg");
const a = JSON.parse(document.getElementById("panels-of-figures").textContent)[0].axes[n], m = svg.getScreenCTM();
const p = new DOMPoint(a.left + share * (a.right - a.left), (a.top + a.bottom) / 2).matrixTransform(m);
svg.dispatchEvent(new PointerEvent(kind, {clientX: p.x, clientY: p.y + down, bubbles: true}));
return document.querySelector(".readout").innerText.replaceAll("−", "-").split("\\n");
"""


@pytest.mark.slow
def test_a_figure_answers_under_the_pointer(tmp_path: Path, browser: Any) -> None:
    """Values of all lines, a cursor in both panels, lines that are hidden by the legend, zoom, folded tables, paper."""
    open_page(browser, curves_page().save(tmp_path / "page.html"))
    head, *rows = browser.execute_script(POINT, 0, 0.5, "pointermove", 0)
    x = float(head.split()[1])
    assert head.startswith("frequency ")
    assert [float(row.partition(": ")[2]) for row in rows[:2]] == pytest.approx([x**2, x**0.5], rel=0.02)
    assert browser.execute_script("return document.querySelectorAll('figure .hair').length") == 2
    _, below, *_ = browser.execute_script(POINT, 1, 0.9, "pointermove", 0)
    x = float(browser.execute_script("return document.querySelector('.readout').innerText").split()[1])
    assert float(below.partition(": ")[2]) == pytest.approx(x - 100, rel=0.02)
    browser.execute_script("document.querySelectorAll('.channel')[1].dispatchEvent(new Event('click'))")
    assert len(browser.execute_script(POINT, 0, 0.5, "pointermove", 0)) == len([head, *rows]) - 1
    box = "return document.querySelector('figure svg').getAttribute('viewBox')"
    whole = browser.execute_script(box)
    browser.execute_script(POINT, 0, 0.2, "pointerdown", -40)
    browser.execute_script(POINT, 0, 0.6, "pointerup", 40)
    assert browser.execute_script(box) != whole
    browser.execute_script("dispatchEvent(new Event('beforeprint')); document.querySelector('.fold').click()")
    assert browser.execute_script(box) == whole
    assert browser.execute_script("return document.querySelector('table').offsetHeight") == 0
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    pypdf = pytest.importorskip("pypdf")
    text = pypdf.PdfReader(io.BytesIO(printed(browser))).pages[0].extract_text()
    assert "Numbers" in text
    assert "1 2" in " ".join(text.split())  # on paper no table is folded


AT_VALUE = """
const [re, im] = arguments, svg = document.querySelector("figure svg");
const a = JSON.parse(document.getElementById("panels-of-figures").textContent)[0].axes[0], m = svg.getScreenCTM();
const share = (v, {low, high}) => (v - low) / (high - low);
const p = new DOMPoint(a.left + share(re, a.x) * (a.right - a.left), a.bottom + share(im, a.y) * (a.top - a.bottom));
const at = p.matrixTransform(m);
svg.dispatchEvent(new PointerEvent("pointermove", {clientX: at.x, clientY: at.y, bubbles: true}));
const readout = document.querySelector(".readout");
return readout.hidden ? "" : readout.innerText.replaceAll("−", "-");
"""


@pytest.mark.slow
def test_a_nyquist_plot_tells_the_frequency_under_the_pointer(tmp_path: Path, browser: Any) -> None:
    """Of L = 4 / (s (s + 1) (s + 2)); the unit circle is no data."""
    s, w = control.tf("s"), 1.1
    loop = 4 / (s * (s + 1) * (s + 2))
    page = render(
        Front("a", "b", "c"), [Section("x", "X", (Illustration(lambda: malta.report.nyquist(loop), "L"),))]
    )
    open_page(browser, page.save(tmp_path / "page.html"))
    value = complex(loop(1j * w))
    told = browser.execute_script(AT_VALUE, value.real, value.imag)
    found = re.search(r" at ([\d.]+) rad/s \(([\d.]+) Hz\)", told)
    assert found is not None
    assert float(found[1]) == pytest.approx(w, rel=0.05)
    assert float(found[2]) == pytest.approx(float(found[1]) / (2 * np.pi), rel=1e-3)
    assert browser.execute_script(AT_VALUE, 0.8, 0.6) == ""  # on the unit circle, far from the curve


@pytest.mark.slow
def test_the_same_controller_gives_the_same_bytes(cart: Analysis, page: Page) -> None:
    assert page_of(cart).content == page.content
    assert pdf_of(page) == pdf_of(page)


def test_a_notebook_shows_the_page_in_a_frame(page: Page) -> None:
    shown = page._repr_html_()
    assert shown.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert shown.count("<") == 2  # the frame alone: what is in it is quoted


def test_a_page_has_the_suffix_of_a_page(page: Page, tmp_path: Path) -> None:
    assert page.save(tmp_path / "new" / "cart.html").read_bytes() == page.content
    with pytest.raises(malta.InputError, match=r"suffix '\.pdf'"):
        page.save(tmp_path / "cart.pdf")


def test_colours_turn_and_unprintable_characters_are_marked() -> None:
    assert dark_colour("000000") == "#ededed"
    assert dark_colour("ffffff") == "#1a1a1a"
    red = dark_colour("c1440e")  # stays red, and becomes lighter
    assert int(red[1:3], 16) > int(red[3:5], 16) > int(red[5:7], 16)
    assert printable("a\x00b\ud800c\n") == "a\ufffdb\ufffdc\n"


@pytest.mark.slow
def test_the_margins_in_a_report_are_those_of_verify(tmp_path: Path, run: Run) -> None:
    gains, out = ROOT / "design" / "gains" / "halbach.json", tmp_path / "page.html"
    assert run("report", gains, "--out", out).code == 0
    verified = json.loads(run("verify", gains, "--json").out)
    html = out.read_text(encoding="utf-8")
    read_page(html)
    lower = verified["robust"]["travel"]["lower"]
    assert f"{at_least(lower).percent()} proven" in html
    chain = {row[0]: row[1] for row in cells_of(html, "Where the margin goes")[1:]}
    for link in verified["robust"]["chain"]:
        assert chain[link["stage"]] == at_least(link["lower"]).percent()
    delays = {row[0]: row[1] for row in cells_of(html, "Margins of the sampled loop")[1:]}
    for sensor, delay in verified["robust"]["delay_s"].items():
        assert delays[f"delay at {sensor} alone"] == f"{1e6 * delay:.0f} µs"


@pytest.mark.slow
def test_the_report_of_a_shipped_design_on_screens_and_paper(tmp_path: Path, browser: Any, run: Run) -> None:
    pypdf = pytest.importorskip("pypdf")
    gains, out = ROOT / "design" / "gains" / "tubular_pid.json", tmp_path / "page.html"
    assert run("report", gains, "--no-proof", "--out", out, "--pdf").code == 0
    html = out.read_text(encoding="utf-8")
    read_page(html)
    assert len(html) < 2_000_000
    assert "y1, x2 and y2 have the curves of x1." in html
    for width in (1280, 390):
        for scheme in ("light", "dark"):
            open_page(browser, out, width=width, scheme=scheme)
            assert browser.execute_script("return document.documentElement.scrollWidth") <= width
            if width == 1280:
                assert browser.execute_script(CUT) == []
            paper, *inks = (
                sum(map(int, re.findall(r"\d+", colour))) for colour in browser.execute_script(COLOURS)
            )
            away = [ink - paper if scheme == "dark" else paper - ink for ink in inks]
            assert max(away) > 500
            assert min(away) > 200  # notes are grey
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    assert (
        printed_overlaps(
            browser, "h1, h2, svg.machine, figure svg, figcaption, table, .caption, p, .key div, dt, dd"
        )
        == []
    )
    sheet = pypdf.PdfReader(io.BytesIO(printed(browser)))
    text = " ".join(" ".join(one.extract_text().split()) for one in sheet.pages)
    peak = max(row[1] for row in cells_of(html, "Gang of four")[1:])
    assert peak in text
    assert "innovations to states" in text
    assert "states to commands" in text
    figures = pypdf.PdfReader(out.with_suffix(".pdf"))
    assert len(figures.pages) == html.count("<figure>")
    assert "/CreationDate" not in (figures.metadata or {})
    for number, one in enumerate(figures.pages, 1):
        assert f"Figure {number}." in one.extract_text()
        fonts = one["/Resources"]["/Font"].get_object()
        assert {font.get_object()["/Subtype"] for font in fonts.values()} == {"/Type0"}  # type 42, embedded


@pytest.mark.slow
def test_an_unstable_loop_has_a_page_that_says_so(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "page.html"
    gains = ROOT / "design" / "gains" / "robust.json"
    said = run("report", gains, "--set", "K_B=15", "--out", out)
    assert said.code == 1
    assert "unstable" in said.err
    html = out.read_text(encoding="utf-8")
    read_page(html)
    assert "<dd><b>✗ UNSTABLE</b>" in html
    assert "changed: K_B=15" in html
    assert "Gang of four" not in html


@pytest.mark.slow
def test_a_campaign_and_the_requirements_stand_in_the_page(tmp_path: Path, run: Run) -> None:
    gains, folder, out = (
        ROOT / "design" / "gains" / "halbach_pid.json",
        tmp_path / "c",
        tmp_path / "page.html",
    )
    report = "report", gains, "--no-proof", "--campaign", folder, "--out", out
    assert run("campaign", gains, "--samples", "64", "--out", folder).code == 0
    assert run(*report).code == 0
    html = out.read_text(encoding="utf-8")
    read_page(html)
    ends = {row[0]: row[1] for row in cells_of(html, "How the runs end")[1:]}
    assert ends["completed"] == "64"
    lights = cells_of(html, "[specification] of the design file")[1:]
    asked = {row[1]: row[0] for row in lights}
    assert asked["peak sensitivity"].startswith("✓")
    assert {"noise motion x", "peak sensitivity", "load error x"} == set(asked)
    before = out.read_bytes()
    assert run(*report).code == 0
    assert out.read_bytes() == before


@pytest.mark.slow
def test_a_known_yield_stands_in_the_verdict_of_the_same_machine(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of campaigns in build/campaigns; a changed machine has none, and what is damaged there disturbs nobody."""
    monkeypatch.chdir(tmp_path)
    gains = ROOT / "design" / "gains" / "calibrated.json"
    assert run("campaign", gains, "--samples", "16").code == 0
    assert run("verify", gains, "--no-proof").out.count("of 16 machines") == 2  # first and last
    controller = malta.gains.read(gains)
    assert [one.runs for one in campaigns_of(None, controller, None)] == [16]
    assert campaigns_of(None, controller, None, changed=True) == []
    (manifest,) = Path("build", "campaigns").glob("*/campaign.json")
    manifest.write_text("{}")
    assert campaigns_of(None, controller, None) == []


def test_the_command_refuses_what_is_no_page(tmp_path: Path, run: Run) -> None:
    gains = ROOT / "design" / "gains" / "robust.json"
    said = run("report", gains, "--out", tmp_path / "page.txt")
    assert said.code == 2
    assert "suffix '.txt'" in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("texts", "box"),
    [
        (None, {"m": 0.2, "K_A": 0.2, "K_B": 0.2, "K_D": 0.2}),
        (["10%"], {"m": 0.1, "K_A": 0.1, "K_B": 0.1, "K_D": 0.1}),
        (["m=10%"], {"m": 0.1}),
    ],
)
def test_an_uncertainty_is_read_as_verify_reads_it(texts: list[str] | None, box: dict[str, float]) -> None:
    path = ROOT / "design" / "gains" / "table2.json"
    assert dict(read_subject(path, malta.gains.read(path), None, texts, None).box) == box
    with pytest.raises(malta.InputError, match="a share above 0 %"):
        read_subject(path, malta.gains.read(path), None, ["m=0%"], None)


@pytest.mark.slow
def test_a_page_says_which_loads_of_any_waveform_touch_nothing() -> None:
    """The figures of malta.margins.load_limits, on the first screen, in the loads' section and among the figures."""
    spec = malta.read_design("examples/ball/design/ball.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    found = analyse(Subject(controller, controller.parameters))
    (limit,) = malta.margins.load_limits(malta.loop(spec.plant, controller))
    size = f"{limit.proven.text()} N"
    shown = {figure.label: figure.value for figure in key_figures(found)}
    assert shown["Any load, touching nothing"] == f"{limit.proven.text(3)} N"
    assert {one.identifier: one.value for one in found.figures}["load_w_safe_N"] == limit.safe.limit
    html = page_of(found).html
    (row,) = [row for row in cells_of(html, "Any load of at most this size")[1:] if row[0] == "w"]
    assert row[1] == size
    assert "Left out: induced voltages, voltage limits and the DC link" in html
    assert "The largest share of a clearance that any waveform of a load uses" in html
    assert analyse(Subject(controller, controller.parameters), proof=False).loads == ()


@pytest.mark.parametrize(
    ("gains", "cause"),
    [("halbach", "loads, with its currents held between readings."), ("robust", "loads."), (None, "")],
)
def test_a_page_says_why_poles_of_its_map_and_table_differ(gains: str | None, cause: str) -> None:
    """Of `halbach` they are 0 and -2.5 rad/s, -1.3 +- 16.7j with held currents; loads move z of `robust` to 24."""
    controller = malta.gains.read(f"design/gains/{gains}.json") if gains else cart_controller()
    plant = malta.plant_of(controller.parameters)
    loop = malta.loop(plant, controller)
    found: Any = SimpleNamespace(
        plant=plant,
        report=SimpleNamespace(model=malta.linearize(plant, plant.at())),
        curves=loop_curves(loop),
    )
    said = pole_difference(found)
    assert bool(said) == bool(cause)
    assert cause in said
    poles, loaded = (np.linalg.eigvals(model.A) for model in (found.report.model, loop.model))
    assert ("loads." in said) == (np.abs(np.sort_complex(poles) - np.sort_complex(loaded)).max() > 20)
