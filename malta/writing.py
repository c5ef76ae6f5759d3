"""Writing files so that nothing is lost or half-written: all or none, each completed beside its target."""

from __future__ import annotations

import glob
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from malta.files import unwritable
from malta.interrupts import put_off_interrupts


def replace_files(contents: Mapping[Path, bytes]) -> None:
    """Write files, all or none: each is completed beside its target before any is renamed into place.

    Content and names are on the disk when the function returns, so that no power failure leaves a file half-written.
    Folders are made as needed. Raises InputError when one cannot be written to; the old files then stand.
    """
    staged: list[tuple[Path, Path]] = []
    try:
        for path, data in contents.items():
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                remove_leftovers(path.parent, glob.escape(path.name[:50]))
                if path.exists() and not path.is_file():
                    raise IsADirectoryError(0, _obstacle(path), str(path))
                temporary = temporary_name(path)
                staged.append((temporary, path))
                with temporary.open("xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            except (OSError, ValueError) as error:
                raise unwritable(path, error) from error
        before = {path: path.read_bytes() if path.exists() else None for _, path in staged}
        with put_off_interrupts():
            _rename(staged, before)
        for folder in {path.parent for _, path in staged}:
            _sync_folder(folder)
    finally:
        for temporary, _ in staged:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def _rename(staged: list[tuple[Path, Path]], before: Mapping[Path, bytes | None]) -> None:
    """Rename files into place, all or none. Raises InputError; the old files stand then."""
    replaced: list[Path] = []
    for temporary, path in staged:
        try:
            temporary.replace(path)
        except OSError as error:
            for other in replaced:
                old = before[other]
                other.unlink() if old is None else other.write_bytes(old)
            raise unwritable(path, error) from error
        replaced.append(path)
    for noted in _notes:
        noted.extend(replaced)


_notes: list[list[Path]] = []  # of `noting_files`


@contextmanager
def noting_files() -> Iterator[list[Path]]:
    """Note the files that are written; yields the list that grows."""
    written: list[Path] = []
    _notes.append(written)
    try:
        yield written
    finally:
        _notes.pop()


def json_text(content: Any) -> str:
    """A JSON document; numbers that are not finite become null."""
    import json  # here, because few commands write one

    def finite(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: finite(entry) for key, entry in value.items()}
        if isinstance(value, list | tuple):
            return [finite(entry) for entry in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(finite(content), indent=1, allow_nan=False)


def temporary_name(path: Path) -> Path:
    """A hidden name beside a file that no other process takes, on this computer or on one that shares the volume."""
    return path.with_name(f".{path.name[:50]}.{writer()}.{os.urandom(4).hex()}")


def remove_leftovers(folder: Path, names: str) -> None:
    """Remove temporary files that killed processes of this computer have left. names : pattern of the files' names"""
    host = writer().rpartition(".")[0]
    for leftover in folder.glob(f".{names}.{host}.*.*"):
        process = leftover.name.split(".")[-2]
        if process.isdigit() and not _is_alive(int(process)):
            with suppress(OSError):
                leftover.unlink()


def _is_alive(process: int) -> bool:
    """Whether a process runs on this computer; True where that cannot be asked."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # of another user
        return True
    return True


def writer() -> str:
    """Computer and process, as they stand in temporary names."""
    import socket  # here, because `malta --help` must not wait for it

    return f"{re.sub('[^A-Za-z0-9-]', '_', socket.gethostname())[:40]}.{os.getpid()}"


def _obstacle(path: Path) -> str:
    return "a folder of that name" if path.is_dir() else "a pipe or a device of that name"


def _sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, on file systems that can."""
    with suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
