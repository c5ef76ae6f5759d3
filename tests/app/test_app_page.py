"""The live page in headless Chromium, and as a widget; skipped where there is no browser."""

from __future__ import annotations

import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import browser as browser, printed, printed_overlaps
from test_app import copied

import malta
from malta.app.answers import Answers
from malta.app.server import Server, script
from malta.app.session import Session

pytestmark = pytest.mark.slow


@pytest.fixture
def page(browser: Any, tmp_path: Path) -> Iterator[Any]:
    """The page of a design, once its margin is proven."""
    session = Session(copied(tmp_path), tmp_path)
    with Server(session) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            browser.get(server.url)
            wait(lambda: "proven" in badge(browser))
            yield browser
            severe = [line for line in browser.get_log("browser") if line["level"] in ("SEVERE", "WARNING")]
            assert severe == []
        finally:
            browser.get("about:blank")
            server.shutdown()
            thread.join()
            session.close()


def wait(is_so: Callable[[], Any], seconds: float = 180.0) -> Any:
    """Wait until a condition holds, and return what it gave."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        found = is_so()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"not so after {seconds:g} s")


def stand_still(browser: Any) -> None:
    """Wait until all has come that follows a design: what comes moves what is below, and a pointer misses it."""
    told = "return document.querySelector('.card.load .note').title"  # of any waveform: the last that follows a proof
    wait(lambda: "any waveform" in str(browser.execute_script(told)).lower())
    seen = [""] * 10

    def is_still() -> bool:
        seen.append(str(browser.execute_script("return document.querySelector('#page').innerHTML")))
        return len(set(seen[-10:])) == 1

    wait(is_still)


def find(browser: Any, selector: str) -> Any:
    return browser.find_element("css selector", selector)


def badge(browser: Any) -> str:
    """The text of the badge; "" before there is one."""
    return text(browser, ".badge b")


def text(browser: Any, selector: str) -> str:
    """The text of the first such element, at once: elements may be drawn anew meanwhile."""
    return str(
        browser.execute_script("return document.querySelector(arguments[0])?.textContent ?? ''", selector)
    )


def press(browser: Any, *keys: str) -> None:
    from selenium.webdriver import ActionChains

    ActionChains(browser).send_keys(*keys).perform()


def row(browser: Any, label: str) -> tuple[Any, Any]:
    """Slider and number field of a row in an open group."""
    return tuple(
        find(browser, f"details[open] [aria-label^='{label}']{kind}")
        for kind in ("[type=range]", "[type=text]")
    )


def test_a_slider_moves_the_design_and_its_proof_follows(page: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    first = badge(page)
    assert first == "✓ proven 288.79 %"
    slider, number = row(page, "stiffness")
    assert number.get_attribute("value") == "647.02"
    page.execute_script("arguments[0].focus()", slider)
    press(page, *[Keys.ARROW_RIGHT] * 8)
    assert float(number.get_attribute("value")) > 647.02
    assert "proven" not in badge(page)  # from the very move on
    wait(lambda: "not proven yet" in text(page, ".badge"))
    wait(lambda: "proven" in badge(page) and badge(page) != first)
    moved, proven = number.get_attribute("value"), badge(page)
    assert float(proven.split()[-2]) < 288.7  # stiffer is less robust
    page.refresh()  # what was changed is kept, and so is what was proven of it
    wait(lambda: badge(page) == proven)
    assert row(page, "stiffness")[1].get_attribute("value") == moved
    page.find_elements("css selector", ".card.table .tabs button")[2].click()
    assert "pid.Kp.F_x" in text(page, ".tables")


def test_the_margin_map_shows_the_proven_box_and_the_poles_where_it_is_clicked(page: Any) -> None:
    find(page, ".card.poles .tabs button[data-value=map]").click()
    wait(lambda: "proven 288.7" in text(page, ".card.poles .note").replace("blue: ", "").replace(",", ""))
    assert len(page.find_elements("css selector", ".card.poles .proven-box")) == 1
    find(page, ".card.poles .chart").click()  # its middle, where the machine of the file is
    wait(lambda: "there stable" in text(page, ".card.poles .note"))
    slider, _ = row(page, "stiffness")
    slider.send_keys("\ue014")  # an arrow to the right: another design, of which nothing is proven yet
    wait(lambda: not page.find_elements("css selector", ".card.poles .proven-box"))
    wait(lambda: page.find_elements("css selector", ".card.poles .proven-box"))


def test_parts_of_a_picture_that_follow_stay_grey_until_they_come(
    page: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, complete = threading.Event(), Answers.complete
    monkeypatch.setattr("malta.app.answers.LONGEST_ANSWER_TIME", 0.0)
    monkeypatch.setattr(Answers, "complete", lambda *found: gate.wait(60) and complete(*found))
    row(page, "stiffness")[0].send_keys("\ue014")
    wait(lambda: len(page.find_elements("css selector", ".card.old")) == 4)
    page.find_elements("css selector", ".card.table .tabs button")[1].click()
    grey = {
        one.find_element("xpath", "./..").find_element("css selector", "th").text
        for one in page.find_elements("css selector", ".figures td.old")
    }
    assert "phase margin" in grey
    assert not grey & {"peak |S|", "bandwidth, T", "slowest pole"}
    gate.set()
    wait(lambda: not page.find_elements("css selector", ".card.old, td.old"))


def test_while_a_slider_is_dragged_axes_stand_still_and_old_values_are_grey(page: Any) -> None:
    """Between input events and the change that ends them; the design of the beginning is a thin line."""
    ticks = "return [...document.querySelectorAll('.card.load .tick')].map((one) => one.textContent).join()"
    wait(lambda: page.find_elements("css selector", ".requirements .light.true"))
    stand_still(page)
    slider, _ = row(page, "stiffness")
    place = round(0.9 * float(slider.get_attribute("value")))
    began, version = (
        page.execute_script(ticks),
        page.execute_script("return document.querySelector('#page').dataset.version"),
    )
    move = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event(arguments[2], {bubbles: true}));"
    page.execute_script(move, slider, place, "input")
    wait(lambda: page.execute_script("return document.querySelector('#page').dataset.version") != version)
    wait(
        lambda: page.find_elements("css selector", ".card.load .line.faint")
    )  # with its part, which may follow
    assert page.execute_script(ticks) == began
    signs = "return [...document.querySelectorAll(arguments[0])].map((one) => one.getAttribute(arguments[1]))"
    assert page.execute_script(signs, ".requirements .light.old", "class")
    assert "met" not in page.execute_script(signs, ".light.old .sign", "aria-label")
    page.execute_script(move, slider, place, "change")
    wait(lambda: page.execute_script(ticks) != began)
    assert not page.find_elements("css selector", ".card.load .line.faint")
    wait(lambda: page.find_elements("css selector", ".requirements .light.false"))
    first = page.execute_script(signs, ".requirements .light", "class")[0]
    assert first.split()[1] == "false"  # failures first


def test_the_page_fits_a_small_screen_and_paper(page: Any) -> None:
    for width in (768, 390):
        screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        wide = "const a = document.querySelector('.cards'); return [a.scrollWidth - a.clientWidth, "
        wide += "document.documentElement.scrollWidth]"
        assert page.execute_script(wide) == [0, width]
    page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    frames = "return [...document.querySelectorAll('.chart rect.frame')].map(f => f.getBoundingClientRect().height)"
    try:  # charts are drawn anew for paper, high enough to be read
        wait(lambda: all(high == 0 or 100 < high < 200 for high in page.execute_script(frames)), 30.0)
        cut = """return [...document.querySelectorAll('.chart .asked')].filter(text => text.tagName === 'text')
            .filter(text => text.getBoundingClientRect().right > text.closest('.chart').getBoundingClientRect().right)
            .map(text => text.textContent)"""
        assert page.execute_script(cut) == []
    finally:
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert printed_overlaps(page, ".bar h2, .chart svg, .legend, .note, .badge, .lights, .tables table") == []
    pypdf = pytest.importorskip("pypdf")
    text = " ".join(sheet.extract_text() for sheet in pypdf.PdfReader(io.BytesIO(printed(page))).pages)
    assert "Sensitivity" in text
    assert "peak sensitivity" in text


def test_undo_redo_and_reset_by_keys(page: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    slider, number = row(page, "damping")
    page.execute_script("arguments[0].focus()", slider)
    press(page, Keys.ARROW_RIGHT)
    wait(lambda: number.get_attribute("value") != "44.551")
    moved = number.get_attribute("value")
    press_with_control(page, "z")
    wait(lambda: number.get_attribute("value") == "44.551")
    press_with_control(page, "y")
    wait(lambda: number.get_attribute("value") == moved)
    page.execute_script("document.activeElement.blur()")
    press(page, "r")
    wait(lambda: number.get_attribute("value") == "44.551")
    wait(lambda: "proven 288.7" in badge(page))  # also where a move comes back to where it began
    press(page, "r")
    time.sleep(0.5)
    wait(lambda: "proven 288.7" in badge(page))


def press_with_control(browser: Any, key: str) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    ActionChains(browser).key_down(Keys.CONTROL).send_keys(key).key_up(Keys.CONTROL).perform()


def test_bad_numbers_are_one_sentence_and_the_last_picture_is_greyed(page: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    _, number = row(page, "stiffness")
    number.click()
    number.send_keys(Keys.CONTROL, "a")
    number.send_keys("stiff", Keys.ENTER)
    wait(lambda: "expected a finite number in N/m" in text(page, ".message"))
    number.send_keys(Keys.ESCAPE)
    seek = find(page, ".seek")
    seek.send_keys("machine.m")
    mass = wait(lambda: find(page, "details[open] [aria-label^='m in kg']"))
    mass.click()
    mass.send_keys(Keys.CONTROL, "a")
    mass.send_keys("-1", Keys.ENTER)
    wait(lambda: "expected a finite number above 0 in kg" in text(page, ".message"))
    assert "failed" in find(page, "#page").get_attribute("class")
    assert badge(page) == "✗ no design"
    press_with_control(page, "z")
    wait(lambda: "failed" not in find(page, "#page").get_attribute("class"))
    assert text(page, ".message") == ""


def test_a_number_may_have_its_unit(page: Any) -> None:
    """Also one with another prefix; a unit of something else is refused, and the message moves nothing."""
    from selenium.webdriver.common.keys import Keys

    _, number = row(page, "stiffness")
    top = "return document.querySelector('main').getBoundingClientRect().top"
    before = page.execute_script(top)

    def value() -> str:
        return str(number.get_attribute("value"))

    for typed, shown in (("640 N/m", "640"), ("0.65 kN/m", "650"), ("7 N s/m", "7 N s/m")):
        page.execute_script("arguments[0].blur(); arguments[0].focus(); arguments[0].select()", number)
        number.send_keys(typed, Keys.ENTER)
        wait(partial(lambda wanted: value() == wanted, shown))
        wait(lambda: "proven" in badge(page))  # an answer takes the sentence of a refused number away
    wait(lambda: 'found "7 N s/m", expected a finite number in N/m' in text(page, ".message"))
    assert page.execute_script(top) == before
    find(page, ".message").click()
    assert text(page, ".message") == ""


def test_a_bound_is_drawn_hatched_where_it_fails_and_pulled(page: Any) -> None:
    """The region above a bound of |S| bears its name; pulled below the curve it fails, and is an edit of the file."""
    from selenium.webdriver.common.keys import Keys

    bound = "return document.querySelector(\".handle[aria-label='bound of peak sensitivity']\")"
    region = "return document.querySelector('.card.sensitivity rect.asked').getAttribute('class')"
    assert page.execute_script(bound).get_attribute("aria-valuetext") == "1.8"
    assert page.execute_script(region) == "asked"
    assert "peak sensitivity ≤ 1.8" in text(page, ".card.sensitivity svg")
    page.execute_script("arguments[0].focus()", page.execute_script(bound))
    press(page, Keys.ARROW_DOWN)
    wait(lambda: page.execute_script(region) == "asked hatched")
    asked = float(page.execute_script(bound).get_attribute("aria-valuetext"))
    assert 1.2 < asked < 1.8
    wait(lambda: f"peak sensitivity ≤ {asked:g} FAILS" in text(page, ".card.sensitivity svg"))
    assert "FAILS" in text(page, ".card.nyquist svg")
    wait(lambda: f"≤ {asked:g}" in text(page, ".requirements .light.false"))
    click(page, "Changes")
    assert "specification.peak_sensitivity" in text(page, ".tables")
    press_with_control(page, "z")
    wait(lambda: page.execute_script(region) == "asked")


def test_a_second_tab_takes_the_design_along(page: Any) -> None:
    """The first says that it lost it, and asks nothing any more; the second has the numbers of the first."""
    slider, number = row(page, "stiffness")
    page.execute_script("arguments[0].focus()", slider)
    from selenium.webdriver.common.keys import Keys

    press(page, Keys.PAGE_DOWN)
    wait(lambda: number.get_attribute("value") != "647.02")
    wait(lambda: "proven" in badge(page))
    moved, first, address = number.get_attribute("value"), page.current_window_handle, page.current_url
    page.switch_to.new_window("tab")
    page.get(address)
    wait(lambda: "proven" in badge(page))
    assert row(page, "stiffness")[1].get_attribute("value") == moved
    second = page.current_window_handle
    page.switch_to.window(first)
    wait(lambda: "another tab" in text(page, ".fatal"))
    page.switch_to.window(second)
    page.close()
    page.switch_to.window(first)


def test_a_pinned_design_gets_its_proof_and_ties_no_star(page: Any) -> None:
    """Pinned before its proof came, its column has it afterwards; a design is not better than itself."""
    from selenium.webdriver.common.keys import Keys

    slider, _ = row(page, "stiffness")
    page.execute_script("arguments[0].focus()", slider)
    press(page, Keys.PAGE_DOWN)
    wait(lambda: "not proven yet" in text(page, ".badge"))
    page.execute_script("document.activeElement.blur()")
    press(page, "p")
    wait(lambda: page.find_elements("css selector", ".pin"))
    wait(lambda: "proven" in badge(page))
    rows = "[...document.querySelectorAll('.figures tbody tr')]"
    row_of = f"{rows}.find((row) => row.textContent.startsWith('margin, proven'))"
    cells = f"return [...({row_of} ?? document.head).querySelectorAll('td')].map((cell) => cell.textContent)"
    wait(lambda: len(set(page.execute_script(cells))) == 1 and "–" not in page.execute_script(cells))
    assert len(page.execute_script(cells)) == 2
    assert "★" not in text(page, ".tables")


def test_pins_are_compared_and_a_design_is_saved(page: Any, tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    page.execute_script("document.activeElement.blur()")
    press(page, "p")
    wait(lambda: len(page.find_elements("css selector", ".pin")) == 1)
    slider, number = row(page, "integral")
    page.execute_script("arguments[0].focus()", slider)
    press(page, Keys.PAGE_UP)
    wait(lambda: number.get_attribute("value") != "6846.1")
    wait(lambda: "★" in text(page, ".tables"))
    assert page.find_elements("css selector", ".line.faint")
    gain = float(number.get_attribute("value"))
    press_with_control(page, "s")
    name = wait(lambda: find(page, "dialog.save input"))
    name.send_keys(Keys.CONTROL, "a")
    name.send_keys("design/mine.toml", Keys.ENTER)
    wait(lambda: "wrote design/mine.toml" in text(page, ".message"))
    spec = malta.read_design(tmp_path / "design" / "mine.toml")
    assert spec.pid is not None
    assert float(spec.pid.Ki[0]) == pytest.approx(gain, rel=1e-5)
    assert text(page, "h1") == "mine"
    press_with_control(page, "s")
    name = wait(lambda: find(page, "dialog.save[open] input"))
    name.send_keys(Keys.ENTER)
    wait(lambda: "exists" in text(page, "dialog.save"))
    press(page, Keys.ESCAPE)


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_page_fits_its_window(page: Any, width: int, height: int) -> None:
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        wait(lambda: page.execute_script("return window.innerWidth") == width)
        wide, high = page.execute_script(
            "const r = document.documentElement; return [r.scrollWidth, r.scrollHeight]"
        )
        assert wide <= width
        assert high <= height
        boxes = page.execute_script(
            "return [...document.querySelectorAll('.chart')].map(c => [c.clientWidth, c.clientHeight])"
        )
        assert all(w > 200 and h > 130 for w, h in boxes)
        sides = (
            "return ['.name', '.machine svg', '.badge'].map(s => document.querySelector('.malta-app ' + s)"
        )
        name, machine, badge = page.execute_script(f"{sides}.getBoundingClientRect().toJSON())")
        assert name["right"] <= machine["left"]
        assert machine["right"] <= badge["left"] or machine["bottom"] <= badge["top"]
        assert 60 < machine["width"] < 80  # px: small, beside the verdict
        if width == 1280:  # no chart is scrolled away
            bottom = page.execute_script(
                "return Math.max(...[...document.querySelectorAll('.card')].map(c => c.getBoundingClientRect().bottom))"
            )
            assert bottom <= height
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_everything_has_a_name_for_screen_readers(page: Any) -> None:
    nameless = page.execute_script(
        """return [...document.querySelectorAll('input, button, select')].filter(e =>
        !e.closest('[hidden]') && !e.textContent.trim() && !e.getAttribute('aria-label') && !e.labels?.length
        ).map(e => e.outerHTML)"""
    )
    assert nameless == []


# --- searches, handles, figures as files ---


def click(browser: Any, words: str) -> None:
    """Press the first button that says this, at once."""
    found = "[...document.querySelectorAll('button')].find((one) => one.textContent === arguments[0])"
    browser.execute_script(f"{found}.click()", words)


def test_a_handle_is_pulled_by_keys_and_undone(page: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    handle = find(page, ".card.nyquist .handle")
    assert handle.get_attribute("role") == "slider"
    assert handle.get_attribute("aria-label") == "phase margin of x"
    first = handle.get_attribute("aria-valuetext")
    _, stiffness = row(page, "stiffness")
    page.execute_script("arguments[0].focus()", handle)
    press(page, Keys.ARROW_DOWN)
    wait(lambda: "phase margin of x" in text(page, ".message"))
    assert "by stiffness and damping" in text(page, ".message")
    wait(lambda: handle.get_attribute("aria-valuetext") != first)
    assert float(handle.get_attribute("aria-valuetext").split("°")[0]) > float(first.split("°")[0])
    assert stiffness.get_attribute("value") != "647.02"
    assert page.execute_script("return document.activeElement") == handle
    press_with_control(page, "z")
    wait(lambda: stiffness.get_attribute("value") == "647.02")


def test_a_handle_is_dragged_and_what_cannot_be_had_is_said(page: Any) -> None:
    from selenium.webdriver import ActionChains

    click(page, "L")
    stand_still(page)
    handle = find(page, ".card.sensitivity .handle")
    assert handle.get_attribute("aria-label") == "crossover of x"
    height = page.execute_script(
        "return document.querySelector('.card.sensitivity').getBoundingClientRect().top"
    )
    ActionChains(page).click_and_hold(handle).move_by_offset(60, 0).perform()
    wait(lambda: "cannot be reached" in text(page, ".card.sensitivity .note"))
    assert text(page, ".message") == ""  # nothing moves under the pointer
    assert height == page.execute_script(
        "return document.querySelector('.card.sensitivity').getBoundingClientRect().top"
    )
    ActionChains(page).release().perform()
    wait(lambda: "the nearest is" in text(page, ".message"))


def test_a_search_streams_designs_that_one_click_takes(page: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    slider, number = row(page, "stiffness")
    page.execute_script("arguments[0].focus()", slider)
    press(page, Keys.PAGE_DOWN)
    wait(lambda: number.get_attribute("value") != "647.02")
    soft = number.get_attribute("value")
    click(page, "Tune from here")
    wait(lambda: page.find_elements("css selector", ".found button"))
    assert page.find_elements("css selector", ".card.load .line.faint")  # as a ghost beside the design
    press(page, Keys.ARROW_LEFT)  # and nothing stands still meanwhile
    wait(lambda: number.get_attribute("value") != soft)
    click(page, "Figures")
    assert "T1" in text(page, ".tables thead")
    click(page, "Stop")
    wait(lambda: "stopped" in text(page, ".tuner"))
    moved = number.get_attribute("value")
    taken = page.execute_script(
        "const one = document.querySelector('.found button'); one.click(); return one.textContent"
    )
    assert "misses" in taken or "holds all" in taken
    assert "% of" not in taken
    wait(
        lambda: number.get_attribute("value") != moved
    )  # stiffer or softer, as far as the search was when it stopped
    press_with_control(page, "z")
    wait(lambda: number.get_attribute("value") == moved)
    click(page, "Clear")
    wait(lambda: not page.find_elements("css selector", ".found button"))


def test_one_slider_moves_along_the_front(page: Any) -> None:
    click(page, "Margin against load")
    wait(lambda: "ended" in text(page, ".tuner"), 120)
    _, number = row(page, "damping")
    seen = []
    slide = "const one = document.querySelector('.master input'); one.value = arguments[0]; "
    slide += (
        "for (const kind of ['input', 'change']) one.dispatchEvent(new Event(kind)); return Number(one.max)"
    )
    last = page.execute_script(slide, 0)
    for place in range(last + 1):
        page.execute_script(slide, place)
        seen.append((text(page, ".master output"), number.get_attribute("value")))
    margins = [float(words.split(" %")[0]) for words, _ in seen]
    assert len(seen) >= 3
    assert margins == sorted(margins)
    assert len({value for _, value in seen}) == len(seen)  # points, nothing between them
    assert all("moved by F_x" in words for words, _ in seen)
    words, _ = seen[-1]
    wait(lambda: badge(page) == f"✓ proven {words.split(' proven')[0]}")  # of the page's own proof


def test_a_figure_is_zoomed_and_written(page: Any) -> None:
    ticks = "return [...document.querySelectorAll('.card.load .tick')].map((one) => one.textContent).join()"
    whole = page.execute_script(ticks)
    page.execute_script("document.querySelector('.card.load .chart').focus()")
    press(page, "+")
    wait(lambda: page.execute_script(ticks) != whole)
    press(page, "0")
    wait(lambda: page.execute_script(ticks) == whole)
    page.execute_script(
        "window.kept = []; URL.createObjectURL = (blob) => { window.kept.push(blob); return 'data:,'; };"
        "HTMLAnchorElement.prototype.click = function () { window.kept.push(this.download); };"
    )
    for kind in ("csv", "svg", "png"):
        page.execute_script(
            "const one = document.querySelector('.card.load .menu'); one.value = arguments[0];"
            "one.dispatchEvent(new Event('change'))",
            kind,
        )
    wait(lambda: page.execute_script("return window.kept.length") == 6)
    names = page.execute_script("return window.kept.filter((one) => typeof one === 'string')")
    assert names == [f"halbach_pid_load.{kind}" for kind in ("csv", "svg", "png")]
    read = "const done = arguments[arguments.length - 1]; window.kept[arguments[0]].text().then(done)"
    csv, svg = (page.execute_async_script(read, k) for k in (0, 2))
    rows = [line.split(",") for line in csv.split("\r\n")[1:-1]]
    assert csv.startswith('"curve","time [s]","outputs [mm]"')
    assert max(float(y) for _, _, y in rows) == pytest.approx(1.22, abs=0.01)
    assert "var(" not in svg
    assert "class=" not in svg
    assert "<text" in svg
    assert page.execute_script("return [window.kept[4].type, window.kept[4].size > 3000]") == [
        "image/png",
        True,
    ]


def test_numbers_are_found_by_what_they_mean(page: Any) -> None:
    seek = find(page, ".seek")
    for words, key in (("mass", "m in kg"), ("stiffness", "stiffness"), ("gain derivative", "F_x in N s/m")):
        page.execute_script("arguments[0].value = ''", seek)
        seek.send_keys(words)
        assert any(
            one.is_displayed()
            for one in page.find_elements("css selector", f"details[open] [aria-label^='{key}']")
        ), words
    seek.send_keys(" nowhere")
    assert not [one for one in page.find_elements("css selector", ".controls .row") if one.is_displayed()]


def test_another_design_is_chosen_on_the_page(browser: Any, tmp_path: Path) -> None:
    design = copied(tmp_path)
    other = design.read_text(encoding="utf-8").replace("647.02", "600").split("[specification]")[0]
    design.with_name("other.toml").write_text(other, encoding="utf-8")
    session = Session(design, tmp_path)
    with Server(session) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            browser.get(server.url)
            wait(lambda: "stable" in badge(browser) or "proven" in badge(browser))
            slider, _ = row(browser, "stiffness")
            slider.send_keys("\ue014")
            wait(lambda: "·" in text(browser, "h1"))
            choose = "const one = document.querySelector('.which select'); one.selectedIndex = 1; "
            choose += "one.dispatchEvent(new Event('change'))"
            browser.execute_script(choose)
            wait(lambda: "pid.Kp.F_x" in text(browser, "dialog.leave[open]"))
            click(browser, "Stay")
            assert text(browser, "h1").startswith("halbach_pid")
            browser.execute_script(choose)
            wait(lambda: text(browser, "dialog.leave[open]"))
            click(browser, "Discard them")
            wait(lambda: "[specification]" in text(browser, ".tables pre"))  # what asking means
            assert row(browser, "proportional gains")[1].get_attribute("value") == "600"
            assert "Tune from here searches" in text(browser, ".tables")
            assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []
        finally:
            browser.get("about:blank")
            server.shutdown()
            thread.join()
            session.close()


def test_a_button_flies_the_worst_load_and_the_page_says_what_any_load_may_be(page: Any) -> None:
    click(page, "worst load")
    wait(lambda: "simulated" in text(page, ".card.run .note"))
    chosen = "return document.querySelector('.card.run select').value"
    assert page.execute_script(chosen) == "worst load"
    wait(lambda: "touches nothing: proven" in text(page, ".card.load .note"))
    title = "return document.querySelector('.card.load .note').title"
    assert "F_x may reach its limit" in page.execute_script(title)


# --- the widget ---

HARNESS = b"""<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<div id="here"></div><script type="module">
import widget from "/bundle.js";
let heard = () => {};
const model = { get: () => 700, on: (_, f) => { heard = f; }, send: (message) => fetch("/message", {method: "POST",
  body: JSON.stringify(message)}).then((r) => r.json()).then((m) => heard(m)) };
widget.render({ model, el: document.getElementById("here") });
</script>"""


class _Harness(BaseHTTPRequestHandler):
    """A notebook's side of the widget: its bundle, and messages to the session."""

    def __init__(self, session: Session, *args: Any) -> None:
        self.session = session
        super().__init__(*args)

    def do_GET(self) -> None:
        bundle = self.path == "/bundle.js"
        self._send("text/javascript" if bundle else "text/html", script().encode() if bundle else HARNESS)

    def do_POST(self) -> None:
        message = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        answer = {"id": message["id"], "body": self.session.answer(message["body"])}
        self._send("application/json", json.dumps(answer).encode())

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


def test_the_bundle_of_the_widget_draws_the_page(browser: Any, tmp_path: Path) -> None:
    session = Session(copied(tmp_path), tmp_path)
    with HTTPServer(("127.0.0.1", 0), partial(_Harness, session)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            browser.get(f"http://127.0.0.1:{server.server_port}/")
            wait(lambda: "stable" in badge(browser))
            assert len(browser.find_elements("css selector", ".chart svg .line")) > 3
            assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []
        finally:
            browser.get("about:blank")
            server.shutdown()
            thread.join()
            session.close()


def test_a_widget_answers_messages_and_is_told_the_proof(tmp_path: Path) -> None:
    pytest.importorskip("anywidget")
    design = copied(tmp_path)
    widget = malta.app.app_widget(malta.read_design(design), folder=tmp_path)
    sent: list[dict[str, Any]] = []
    widget.send = sent.append
    try:
        widget._handle_custom_msg(
            {"id": 1, "body": {"ask": "evaluate", "number": 1, "values": {"pid.Kp.F_x": 700.0}}}, []
        )
        assert sent[0]["id"] == 1
        assert sent[0]["body"]["stable"]
        proof = wait(
            lambda: next((m["news"] for m in sent if m.get("news", {}).get("kind") == "proof"), None)
        )
    finally:
        widget.close()
    assert 2.0 < proof["lower"] <= proof["upper"]
    assert dict(widget.session.edit.values) == {"pid.Kp.F_x": 700.0}
    assert np.isfinite(proof["seconds"])


def test_a_notebook_shows_the_widget(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    design = copied(tmp_path)
    cell = nbformat.v4.new_code_cell(
        f"import malta\nw = malta.app.app_widget({str(design)!r}, folder={str(tmp_path)!r})\nw"
    )
    ended = nbformat.v4.new_code_cell("w.close()")
    notebook = nbformat.v4.new_notebook(cells=[cell, ended])
    nbclient.NotebookClient(notebook, timeout=120).execute()
    assert "application/vnd.jupyter.widget-view+json" in notebook.cells[0].outputs[0]["data"]


def set_number(browser: Any, label: str, value: str) -> None:
    """Type a number into the field of a row."""
    number = row(browser, label)[1]
    number.clear()
    number.send_keys(f"{value}\ue007")


def test_what_the_judge_alone_knows_is_hatched_where_it_binds(page: Any) -> None:
    """An unstable loop has no curve of |S| that enters a region; the bound fails all the same, and says so."""
    set_number(page, "damping", "200")
    wait(lambda: "unstable" in text(page, ".badge"))
    wait(lambda: "FAILS" in text(page, ".card.nyquist .asked.fails"), 60.0)
    assert page.find_elements("css selector", ".card.nyquist ellipse.hatched")


def test_no_text_of_a_chart_lies_over_another(page: Any) -> None:
    set_number(page, "damping", "60")
    wait(lambda: "FAILS" in text(page, ".card.sensitivity .asked.fails"), 60.0)
    clashes = """const over = (a, b, [low, high]) => Math.min(a[high], b[high]) - Math.max(a[low], b[low]);
        const texts = [...document.querySelectorAll('.card.sensitivity svg text')];
        const boxes = texts.map((one) => one.getBoundingClientRect()), name = (k) => texts[k].textContent;
        return boxes.flatMap((a, k) => boxes.flatMap((b, j) => j > k && over(a, b, ['left', 'right']) > 1
          && over(a, b, ['top', 'bottom']) > 4 ? [`${name(k)} | ${name(j)}`] : []));"""
    assert page.execute_script(clashes) == []


def test_a_dark_page_prints_dark_letters(page: Any) -> None:
    find(page, "[aria-label='light or dark']").click()
    assert page.execute_script("return document.querySelector('#page').dataset.theme") == "dark"
    lightness = (
        "return getComputedStyle(document.querySelector(arguments[0])).fill.match(/[0-9]+/g).map(Number)"
    )
    assert min(page.execute_script(lightness, ".chart .axis")) > 200
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        assert max(page.execute_script(lightness, ".chart .axis")) < 100
    finally:
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
