"""Gain files in their three forms, with seals renewed."""

from __future__ import annotations

import io
import json
import subprocess
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st
from pydantic import ValidationError

import malta
from fuzz.cases import ROOT, Case, require_finite
from fuzz.edits import NAMES, cut, edited
from fuzz.oracle import Defect, Ended, line, observe
from malta.campaigns.plan import box_of
from malta.gains import encodings
from malta.gains.file import content_of
from malta.gains.schema import GainFile
from malta.simulation.engine.compiled import compiler


@cache
def gain_document(name: str) -> dict[str, Any]:
    """The document of a gain file; "linear": of a loop of plain matrices."""
    if name != "linear":
        return encodings.decode(ROOT / "design" / "gains" / f"{name}.json")
    model, controller = cart()
    return malta.gains.document(controller, malta.verify(model, controller))


def cart(z: str = "z", v: str = "v", u: str = "u") -> tuple[Any, Any]:
    """The model of a machine of plain matrices with these signals, and a controller."""
    plant = malta.linear_machine(
        [[0, 1], [100, -1]], [[0], [2]], [[1, 0]],
        name="cart", states=[f"{z} [m]", f"{v} [m/s]"], inputs=[f"{u} [N]"], outputs=[f"{z} [m]"],
        nominal={"k": 1.0}, terms={"k": [[[0, 0], [1, 0]]]}, noise=1e-6, limit=10.0,
    )  # fmt: skip
    model = malta.linearize(plant, plant.at())
    weights = malta.synthesis.weights([10, 1], [1], [1e-2], [1e-8], q_i=[10])
    return model, malta.lqg(model, weights, 1e-3, name="cart")


def signed(document: Any) -> Any:
    """A document with the sha256 of what its reader makes of it."""
    if not isinstance(document, dict):
        return document
    try:
        plain = GainFile.model_validate(document).model_dump(by_alias=True, exclude_unset=True)
    except (ValidationError, RecursionError, ValueError):
        return document
    return document | {"sha256": encodings.content_sha256(plain)}


def _gain_json(document: Any, case: Case) -> bytes:
    return cut(json.dumps(document).encode(errors="surrogatepass"), case.cuts)


def _gain_npz(document: Any, case: Case) -> bytes:
    """Cuts change the members before their checksums are made."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entries = list(encodings.flat_entries(encodings.columns_of(document)).items())
        chosen = int(case.cuts[0].at * len(entries)) if case.cuts and case.sealed else -1
        for k, (name, value) in enumerate(entries):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.zeros(0) if value is None else np.array(value))
            data = cut(member.getvalue(), case.cuts[1:] or case.cuts) if k == chosen else member.getvalue()
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), data)
    return buffer.getvalue() if case.sealed else cut(buffer.getvalue(), case.cuts)


def _gain_mat(document: Any, case: Case) -> bytes:
    body = cut(encodings.to_mat(document)[encodings.MAT_HEADER :], case.cuts)
    return encodings.mat_header(body) + body


_FORMS: dict[str, Callable[[Any, Case], bytes]] = {".json": _gain_json, ".npz": _gain_npz, ".mat": _gain_mat}


def read_gain_file(case: Case, folder: Path, suffix: str) -> Ended | None:
    """Read a gain file; None where this form cannot hold the edited document. What was read is finite."""
    document = edited(gain_document(case.base), case.edits)
    path = folder / f"mine{suffix}"
    try:
        path.write_bytes(_FORMS[suffix](signed(document) if case.sealed else document, case))
    except Exception:  # numpy and scipy do not write every document
        return None
    ended = observe(lambda: malta.gains.read(path), folder, [str(path)])
    if ended.code == 0:
        require_finite(ended.value)
        if not case.sealed and not case.cuts and content_of(path)[1] != _content(case.base):
            raise Defect("a changed document with the old seal was read")
    return ended


@cache
def _content(name: str) -> dict[str, Any]:
    """The document of a gain file as its reader returns it."""
    return GainFile.model_validate(gain_document(name)).model_dump(by_alias=True, exclude_unset=True)


def read_shares_of(case: Case, folder: Path) -> Ended | None:
    """Read the spread of a campaign from a gain file."""
    path = folder / "mine.json"
    document = edited(gain_document(case.base), case.edits)
    path.write_bytes(_gain_json(signed(document), case))
    read = observe(lambda: malta.gains.read(path), folder, [str(path)])
    return observe(lambda: box_of(path), folder, [str(path)]) if read.code == 0 else read


def export_as_c(case: Case, folder: Path) -> Ended | None:
    """`malta export FILE`: whatever names signals have, it is C that a compiler reads."""
    path, out = folder / "mine.json", folder / "c"
    document = edited(gain_document(case.base), case.edits)
    path.write_bytes(_gain_json(signed(document), case))
    return _exported(path, out)


def _exported(path: Path, out: Path) -> Ended:
    """Export a gain file as C; Defect where the compiler finds that it is none."""
    ended = observe(line("export", str(path), "--out", str(out)), path.parent, [str(path)], writes=True)
    sources, cc = [str(file) for file in out.rglob("*.c")], compiler()
    if ended.code == 0 and sources and cc is not None:
        command = [*cc, "-std=c99", "-fsyntax-only", "-Wcomment", "-Werror", f"-I{out}", *sources]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise Defect(f"C that is none: {done.stderr[:500]}")
    return ended


def draw_figures(case: Case, folder: Path) -> Ended | None:
    """`malta plot FILE`: names of signals stand in titles and legends."""
    path = folder / "mine.json"
    document = edited(gain_document(case.base), case.edits)
    path.write_bytes(_gain_json(signed(document), case))
    drawn = line("plot", str(path), "step", "--out", str(folder / "step.png"))
    return observe(drawn, folder, [str(path)], writes=True)


class Named(NamedTuple):
    """What is done with a gain file whose signals have these names."""

    does: str  # a key of _NAMED
    names: tuple[str, ...]


def use_names(case: Named, folder: Path) -> Ended | None:
    """Write a gain file, and a log of its loop at rest; then run a command on them."""
    path, log = folder / "mine.json", folder / "mine.csv"

    def written() -> None:
        model, controller = cart(*case.names)
        malta.gains.write(controller, malta.verify(model, controller), path)
        still = malta.Scenario("still", 0.02, malta.references.hold, noise=1.0, fidelity="force")
        run = malta.simulate(model.plant, controller, still)
        malta.identification.write_log(malta.identification.log_of(run), log)

    ended = observe(written)
    if ended.code:
        return ended
    if case.does == "export":
        return _exported(path, folder / "c")
    arguments = [text.replace("OUT", str(folder / "out")) for text in _NAMED[case.does]]
    return observe(
        line(arguments[0], str(log if case.does == "log" else path), *arguments[1:]), folder, writes=True
    )


_NAMED = {
    "export": ("export",),
    "fmu": ("export", "--to", "fmu", "--out", "OUT"),
    "plot": ("plot", "step", "bode", "load", "--out", "OUT"),
    "report": ("report", "--out", "OUT.html"),
    "log": ("log",),
    "simulate": ("simulate", "--json"),
    "verify": ("verify", "--uncertain", "k=10%", "--certificate", "OUT.json"),
}
_SIGNALS = st.sampled_from(
    [name for name in NAMES if "." not in name]
)  # a dot is refused before a file is written
NAMED = st.builds(
    Named, st.sampled_from(tuple(_NAMED)), st.lists(_SIGNALS, min_size=3, max_size=3, unique=True).map(tuple)
)


def show_scenarios(case: Case, folder: Path) -> Ended | None:
    """`malta simulate FILE --scenario help`, which reads a gain file as every command does."""
    path = folder / "mine.json"
    document = edited(gain_document(case.base), case.edits)
    path.write_bytes(_gain_json(signed(document), case))
    return observe(line("simulate", str(path), "--scenario", "help"), folder, [str(path)])
