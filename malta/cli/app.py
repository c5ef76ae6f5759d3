"""`malta app`: a local page to design with."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.options import MachineFile
from malta.cli.output import print_note
from malta.errors import InputError
from malta.files import locate

if TYPE_CHECKING:
    from malta.app.session import Session

FIRST = "design"  # the folder whose first design opens where none is named


def app(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="DESIGN", help="A design file. [the first of design/]", show_default=False),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print the address of the page.")
    ] = False,
    port: Annotated[
        int, typer.Option(metavar="N", min=0, max=65535, help="Port of 127.0.0.1; 0: any that is free.")
    ] = 0,
    machine_file: MachineFile = None,
) -> None:
    """Open a page to design with: sliders for weights, gains and the machine, curves at every move, then the proof.

    The page is served to this computer alone, under an address with a secret token. It saves design files and gain
    files in the folder it was started in, and nowhere else. Ctrl-C ends it.

    \b
    Example:  malta app design/robust.toml
    """
    import webbrowser

    from malta.app.server import Server
    from malta.app.session import Session

    design = _design_file(file)
    if machine_file is not None:
        from malta.model.machines import machine

        machine(machine_file)
    session = Session(design, Path.cwd(), machine_file)
    gc.freeze()
    gc.set_threshold(
        20_000, 5, 5
    )  # a page runs for hours: expressions of past machines go, the libraries stay
    with Server(session, port) as server:
        print(server.url, flush=True)
        if not no_browser and not (_has_screen() and webbrowser.open(server.url)):
            print_note("no browser found: open the address above in one")
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print_note(_farewell(session))
        finally:
            session.close()


def _has_screen() -> bool:
    """Whether a browser would open beside the terminal, and not in it."""
    return not sys.platform.startswith("linux") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def _design_file(named: Path | None) -> Path:
    """The design file that was named, or the first of design/. Raises InputError where there is none."""
    if named is not None:
        if named.suffix in (".json", ".npz", ".mat"):
            raise InputError(
                named, "", "a gain file", "the design file that it was made of, as design/NAME.toml"
            )
        return locate(named)
    found = sorted(Path(FIRST).glob("*.toml"))
    if not found:
        raise InputError("app", "", "no design file", f"its name, or a folder {FIRST}/ with some")
    return found[0]


def _farewell(session: Session) -> str:
    """What Ctrl-C left unsaved, in one sentence."""
    unsaved = session.unsaved_changes()
    name = session.files.path.name
    if not unsaved:
        return f"ended; {name} holds all that was changed"
    shown = ", ".join(unsaved[:4]) + (f" and {len(unsaved) - 4} more" if len(unsaved) > 4 else "")
    return f"ended; not saved to {name}: {shown}"
