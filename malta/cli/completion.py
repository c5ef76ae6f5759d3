"""What a shell offers at the Tab key: gain files, designs, scenarios, parameters. Whatever fails offers nothing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

GAINS = (".json", ".npz", ".mat")
DESIGNS = (".toml",)


def gain_files(incomplete: str) -> list[str]:
    """Gain files: those in design/gains at first, later files and folders below what was typed."""
    return _files(incomplete, Path("design", "gains"), GAINS)


def complete_designs(incomplete: str) -> list[str]:
    """Design files: those in design/ at first, later files and folders below what was typed."""
    return _files(incomplete, Path("design"), DESIGNS)


def scenarios(ctx: Any, incomplete: str) -> list[str]:
    """The scenarios of the machine of the gain file that was typed."""
    found: list[str] = []
    with suppress(Exception):
        from malta import gains
        from malta.model.data import plant_of
        from malta.simulation.catalogue import experiments_of

        plant = plant_of(gains.read(_typed_gains(ctx)).parameters)
        found = [name for name in experiments_of(plant) if name.startswith(incomplete)]
    return found


def parameters(ctx: Any, incomplete: str) -> list[str]:
    """The parameters in the gain file that was typed, as `m=`."""
    found: list[str] = []
    with suppress(Exception):
        from malta.gains.encodings import decode

        names = decode(_typed_gains(ctx))["plant"]["parameters"]
        found = [f"{name}=" for name in names if name.startswith(incomplete)]
    return found


def _typed_gains(ctx: Any) -> Path:
    """The gain file that was typed; behind an option without its value it is still among the bare arguments."""
    from malta.files import locate

    words = [ctx.params.get("gains"), *ctx.args]
    return locate(next(word for word in words if word and Path(word).suffix in GAINS))


def _files(incomplete: str, usual: Path, suffixes: tuple[str, ...]) -> list[str]:
    """Files with one of the suffixes and folders that begin with what was typed; in the usual folder without it."""
    with suppress(OSError):
        if not incomplete and usual.is_dir():
            return sorted(f"{path}" for path in usual.iterdir() if path.suffix in suffixes)
        typed = Path(incomplete)
        folder, start = (typed, "") if incomplete.endswith("/") else (typed.parent, typed.name)
        entries = [path for path in folder.iterdir() if path.name.startswith(start)]
        found = [f"{path}/" for path in entries if path.is_dir()]
        return sorted(found + [f"{path}" for path in entries if path.suffix in suffixes])
    return []
