"""Writing files so that nothing is lost or half-written."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
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
                handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
                staged.append((Path(name), path))
                with os.fdopen(handle, "wb") as file:
                    file.write(data)
                Path(name).chmod(0o644)
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
            temporary.unlink(missing_ok=True)


def _refused(path: Path, error: OSError | ValueError) -> InputError:
    reason = getattr(error, "strerror", None) or str(error)
    blamed = getattr(error, "filename", None)
    if blamed and Path(blamed) in path.parents:
        reason += f" ({blamed})"
    return InputError(path, "", reason, "a place to write the file to")
