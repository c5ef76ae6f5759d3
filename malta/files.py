"""Finding and reading files, with a sentence for every refusal."""

from __future__ import annotations

import atexit
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TypeVar

from malta.errors import InputError

PACKAGE = Path(__file__).resolve().parent
FOLDERS = ("data", "design", "notebooks", "examples")  # that come with malta
MAX_FILE_BYTES = 100_000_000  # bytes of a file to read
MAX_COMPARED_NAMES = 1000  # entries of a folder that a missing file's name is compared with
_Content = TypeVar("_Content", str, bytes)


def shipped_path(*parts: str) -> Path:
    """A file or folder that comes with malta, as `shipped_path("data", "tubular.toml")`.

    An installed package holds data/, design/, notebooks/ and examples/ in its folder `shipped`, which may lie in a zip;
    in a checkout they stand beside the package.
    """
    inside = _unpack() if PACKAGE.parent.is_file() else PACKAGE / "shipped"
    return (inside if inside.is_dir() else PACKAGE.parent).joinpath(*parts)


def read_packaged(name: str) -> bytes:
    """A file beside the modules, as `read_packaged("report/page/style.css")`: of a folder or of a zip."""
    from importlib.resources import files

    return files("malta").joinpath(name).read_bytes()


@cache
def _unpack() -> Path:
    """What comes with malta, from the zip that the package lies in, as files of this process."""
    import zipfile

    folder = Path(tempfile.mkdtemp(prefix="malta-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    with zipfile.ZipFile(PACKAGE.parent) as archive:
        archive.extractall(folder, [name for name in archive.namelist() if name.startswith("malta/shipped/")])
    return folder / "malta" / "shipped"


def version() -> str:
    """The version of malta; "unknown" of one without metadata, as its folder alone in a zip."""
    from importlib import metadata

    try:
        return metadata.version("malta")
    except metadata.PackageNotFoundError:
        return "unknown"


def locate(path: str | Path) -> Path:
    """The file that a user names: where he says, or of the same name among those that come with malta.

    `design/gains/robust.json` is thus found from any folder, and a file of the user's own goes first.
    """
    path = Path(path)
    if path.is_absolute() or (path.parts[:1] and path.parts[0] not in FOLDERS) or file_exists(path):
        return path
    other = shipped_path(*path.parts)
    return other if file_exists(other) else path


def require_plain_name(name: str, where: str | Path, field: str) -> None:
    """Raise InputError for a name that is to be part of a file's name and could lead to another folder."""
    if not re.fullmatch(r"\w[\w .,()\[\]$+-]{0,79}", name):
        expected = "letters, digits, spaces and . , ( ) [ ] $ + - _, at most 80, as in the name of a file"
        raise InputError(where, field, repr(name), expected)


PICTURES = (".png", ".svg", ".pdf")
"""Suffixes of figures."""


def require_suffix(path: Path, *suffixes: str) -> Path:
    """The same path. Raises InputError for another suffix than these, in small or large letters."""
    if path.suffix.lower() not in suffixes:
        expected = "one of " + ", ".join(suffixes) if suffixes[1:] else suffixes[0]
        raise InputError(path, "", f"suffix {path.suffix!r}", expected)
    return path


def file_exists(path: Path) -> bool:
    """Whether there is a file or folder of a name; False for a name that no file can have."""
    try:
        return path.exists()
    except (OSError, ValueError):  # too long, with a null byte, in a folder that may not be looked into
        return False


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for a block of files that are not kept. Raises InputError where they cannot be written."""
    import tempfile  # where something is compiled

    try:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)
    except OSError as error:
        raise unwritable(Path(tempfile.gettempdir()), error) from error


def read_file(
    path: Path, kind: str, read: Callable[[Path], _Content], largest: int | None = None
) -> _Content:
    """What `read` makes of a file; InputError when it is missing or unreadable. `kind` as "TOML file".

    Pipes and devices, which may never end, are refused, and so are files of more than `largest` bytes (MAX_FILE_BYTES).
    """
    try:
        status = path.stat()
        if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
            raise InputError(path, "", "a pipe or a device", f"a {kind}")
        size, most = status.st_size, MAX_FILE_BYTES if largest is None else largest
        if size > most and stat.S_ISREG(status.st_mode):
            raise InputError(path, "", f"{size} bytes", f"a {kind} of at most {most}")
        return read(path)
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(path, "", "no such file", f"a {kind}{_neighbour(path)}") from error
    except UnicodeDecodeError as error:
        raise InputError(path, "", "bytes that are not UTF-8 text", f"a {kind}") from error
    except (OSError, ValueError) as error:
        words = getattr(error, "strerror", None) or str(error)
        found = "a null byte in its name" if "\0" in str(path) else words
        raise InputError(path, "", found, f"a readable {kind}") from error


def _neighbour(path: Path) -> str:
    """The question that ends a refusal, where a file of nearly that name stands, or a folder of nearly its folder's."""
    here = path.parent if path.parent.is_dir() else _most_like(path.parent)
    other = here and (here / path.name if file_exists(here / path.name) else _most_like(here / path.name))
    return f" (did you mean {other}?)" if other else ""


def _most_like(path: Path) -> Path | None:
    """The file or folder beside a path whose name is most like its own, those of its kind first; None: none is."""
    from difflib import get_close_matches  # where something is wrong already

    try:
        names = [entry.name for entry in islice(path.parent.iterdir(), MAX_COMPARED_NAMES)]
    except (OSError, ValueError):
        return None
    for some in ([name for name in names if Path(name).suffix == path.suffix], names):
        close = get_close_matches(path.name, some, n=1, cutoff=0.8)
        if close:
            return path.with_name(close[0])
    return None


def unwritable(path: Path, error: OSError | ValueError) -> InputError:
    """The refusal of a place that a file cannot be written to."""
    reason = getattr(error, "strerror", None) or str(error)
    blamed = getattr(error, "filename", None)
    if blamed and Path(blamed) in path.parents:
        reason += f" ({blamed})"
    return InputError(path, "", reason, "a place to write the file to")
