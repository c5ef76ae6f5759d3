"""Headless Chromium for tests of pages; a test that asks for it is skipped where there is none."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    *(
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-sync",
    ),
    *("--disable-background-networking", "--disable-component-update", "--window-size=1280,800"),
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Headless Chromium with its log."""
    webdriver = pytest.importorskip("selenium.webdriver")
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium with its chromedriver")
    options = Options()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield opened
    finally:
        opened.quit()


def open_page(browser: Any, file: Path, *, width: int = 1280, scheme: str = "light") -> None:
    """Open a file at a width of the screen, px, in a colour scheme."""
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.get(file.resolve().as_uri())


def printed(browser: Any) -> bytes:
    """The PDF that the page prints to."""
    found = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    return base64.b64decode(found["data"])


PAPER_WIDTH = 690  # px, of A4 between its margins
# A block that is broken over columns has several boxes.
OVERLAPS = """const blocks = [...document.querySelectorAll(arguments[0])].filter((one) => one.getClientRects().length);
const clashes = [], name = (node) => `${node.tagName} ${node.getAttribute("class") ?? ""}`.trim();
for (const [k, one] of blocks.entries()) for (const a of one.getClientRects()) {
  if (a.right > innerWidth + 1) clashes.push(`${name(one)} is ${Math.round(a.right - innerWidth)} px too wide`);
  for (const other of blocks.slice(k + 1)) for (const b of other.getClientRects()) {
    if (one.contains(other) || other.contains(one)) continue;
    const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const tall = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (wide > 2 && tall > 2) clashes.push(`${name(one)} over ${name(other)}`);
  }
}
return clashes;"""


def printed_overlaps(browser: Any, selector: str) -> list[str]:
    """Blocks of the page that lie over each other, or beyond its edge, on paper: by their bounding boxes."""
    screen = {"width": PAPER_WIDTH, "height": 980, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        found: list[str] = browser.execute_script(OVERLAPS, selector)
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    return found
