"""Pictures of the gallery, the front page of the documentation: python docs/gallery.py [NAME]...

Each card of docs/index.md names a picture and a command: the command is run in a new folder, and what it draws becomes
docs/gallery/NAME.png for light pages and NAME_dark.png for dark ones, small for the card, and large in full/ for
docs/pictures.md. Pages are photographed in headless Chromium;
where there is none their pictures stay.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

from malta.report.page.document import dark_colours

ROOT = Path(__file__).parents[1]  # shipped files are named as in a checkout
PAGE = ROOT / "docs" / "index.md"
FOLDER = ROOT / "docs" / "gallery"
CARD = re.compile(r"gallery/(\w+)_dark\.png\n.*?^`(malta .*?)`$", re.MULTILINE | re.DOTALL)
SIZES = {
    FOLDER: (420, 315),
    FOLDER / "full": (1000, 750),
}  # pixels, at most, of a card's picture and of a page's
COLOURS, MORE_COLOURS = 26, 64  # of small and of large pictures
SCREEN = (1280, 900)
DRAWS, PROOF = 3.0, 60.0  # s, in which a page draws, and at most until the live page has its proof


def cards(page: str) -> dict[str, str]:
    """The commands of a page's cards by the names of their pictures."""
    return dict(CARD.findall(page))


def draw(names: list[str]) -> Iterator[Path]:
    """Run the commands of the named cards, of all without names, and write their pictures."""
    for place in SIZES:
        place.mkdir(exist_ok=True)
    for name, command in cards(PAGE.read_text(encoding="utf-8")).items():
        if names and name not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            light, dark = pictures(name, command, Path(folder))
        for suffix, picture in (("", light), ("_dark", dark)):
            if picture is None:
                print(f"{name}{suffix}: no Chromium, the picture stays", file=sys.stderr)
                continue
            whole = picture.convert("RGB")
            whole = whole.crop((0, 0, whole.width, min(whole.height, int(0.75 * whole.width))))
            for place, size in SIZES.items():
                small = whole.copy()
                small.thumbnail(size, Image.Resampling.LANCZOS)
                file = place / f"{name}{suffix}.png"
                few_colours(small, COLOURS if place == FOLDER else MORE_COLOURS).save(file, optimize=True)
                yield file


def few_colours(picture: Image.Image, count: int = COLOURS) -> Image.Image:
    """A picture of `count` of its own colours: the most frequent one, then each time the one that is missed most.

    A colour is missed by its distance from those that are chosen, and by how often it stands in the picture.
    """
    pixels = np.asarray(picture).reshape(-1, 3)
    rows, which, counts = np.unique(pixels, axis=0, return_inverse=True, return_counts=True)
    colours, often = rows.astype(float), np.sqrt(counts)
    chosen, far, nearest = (
        [int(counts.argmax())],
        np.full(len(rows), np.inf),
        np.zeros(len(rows), dtype=np.uint8),
    )
    while True:
        away = ((colours - colours[chosen[-1]]) ** 2).sum(axis=1)
        nearest[away < far] = len(chosen) - 1
        far = np.minimum(far, away)
        if len(chosen) == min(count, len(rows)):
            break
        chosen.append(int((far * often).argmax()))
    drawn = Image.fromarray(nearest[which].reshape(picture.height, picture.width), mode="P")
    drawn.putpalette(rows[chosen].ravel().tolist())
    return drawn


def pictures(name: str, command: str, folder: Path) -> tuple[Image.Image | None, Image.Image | None]:
    """What a command draws, on a light page and on a dark one."""
    malta = f"{sys.executable} -m malta"
    places = {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
    if command.startswith("malta app"):
        line = f"{command} --no-browser".replace("malta", malta, 1).split()
        with subprocess.Popen(
            line, cwd=folder, env=os.environ | places, stdout=subprocess.PIPE, text=True
        ) as server:
            assert server.stdout is not None
            address = server.stdout.readline().strip()
            found = [photograph(address, dark=dark) for dark in (False, True)]
            server.terminate()
        return found[0], found[1]
    (folder / "design").symlink_to(ROOT / "design")  # pages name files as they are typed
    shell = command.replace("malta ", f"{malta} ")
    subprocess.run(shell, shell=True, check=True, cwd=folder, env=os.environ | places, capture_output=True)
    drawn = sorted(folder.rglob("*.png"))
    page = max(folder.rglob("*.html"), key=lambda file: file.stat().st_mtime_ns, default=None)
    if page is not None and not drawn:
        found = [photograph(page.as_uri(), dark=dark) for dark in (False, True)]
        return found[0], found[1]
    (file,) = [file for file in drawn if file.stem.endswith(name)]
    light = Image.open(file).convert("RGB")
    rows = np.asarray(light).reshape(-1, 3) / 255
    dark = np.round(255 * dark_colours(rows)).astype(np.uint8).reshape(light.height, light.width, 3)
    return light, Image.fromarray(dark)


def photograph(address: str, *, dark: bool) -> Image.Image | None:
    """A page in headless Chromium; None where there is none."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        return None
    options = Options()
    options.binary_location = browser
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
        options.add_argument(flag)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    screen = {"width": SCREEN[0], "height": SCREEN[1], "deviceScaleFactor": 1, "mobile": False}
    opened = webdriver.Chrome(options=options, service=Service(driver))
    try:
        opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
        opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        opened.get(address)
        until = time.monotonic() + PROOF
        while address.startswith("http") and time.monotonic() < until:
            time.sleep(1.0)
            if opened.execute_script("return document.querySelector('.badge.proven') !== null"):
                break
        time.sleep(DRAWS)
        return Image.open(io.BytesIO(opened.get_screenshot_as_png()))
    finally:
        opened.quit()


if __name__ == "__main__":
    for written in draw(sys.argv[1:]):
        print(written.relative_to(ROOT))
