"""Writing files so that nothing is lost or half-written."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from malta.errors import InputError


def replace_files(contents: Mapping[Path, bytes]) -> None:
    """Write files, all or none: each is completed beside its target before any is renamed into place.

    Folders are made as needed. Raises InputError when one cannot be written to; the old files then stand.
    """
    staged: list[tuple[Path, Path]] = []
    try:
        for path, data in contents.items():
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary = path.with_name(f".{path.name}.{os.getpid()}")
                staged.append((temporary, path))
                with temporary.open("xb") as file:
                    file.write(data)
                if path.is_dir():
                    raise IsADirectoryError(0, "a folder of that name", str(path))
            except (OSError, ValueError) as error:
                raise _refused(path, error) from error
        before = {path: path.read_bytes() if path.exists() else None for _, path in staged}
        replaced: list[Path] = []
        for temporary, path in staged:
            try:
                temporary.replace(path)
            except OSError as error:
                for other in replaced:
                    old = before[other]
                    other.unlink() if old is None else other.write_bytes(old)
                raise _refused(path, error) from error
            replaced.append(path)
    finally:
        for temporary, _ in staged:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def _refused(path: Path, error: OSError | ValueError) -> InputError:
    reason = getattr(error, "strerror", None) or str(error)
    blamed = getattr(error, "filename", None)
    if blamed and Path(blamed) in path.parents:
        reason += f" ({blamed})"
    return InputError(path, "", reason, "a place to write the file to")
