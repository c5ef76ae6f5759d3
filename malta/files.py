"""Reading files with a sentence for every refusal; writing them so that nothing is lost or half-written."""

from __future__ import annotations

import atexit
import glob
import math
import os
import re
import shutil
import signal
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from malta.errors import InputError

# Ctrl-C: noted where libraries may drop the KeyboardInterrupt, and put off where files are renamed into place.


Handler = Callable[[int, FrameType | None], Any]


@contextmanager
def watch_interrupts() -> Iterator[list[float]]:
    """Note when Ctrl-C was pressed (s, monotonic), and let it raise as usual; nothing is noted outside the main thread.

    Libraries may drop the KeyboardInterrupt: whoever watches can raise it again.
    """
    pressed: list[float] = []
    handle = _usual_handler()
    if handle is None:
        yield pressed
        return

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(time.monotonic())
        handle(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, handle)


def press_again() -> None:
    """Press Ctrl-C for the main thread, also where it waits."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)


def is_interrupt(error: BaseException) -> bool:
    """Whether an error is Ctrl-C: KeyboardInterrupt, or what C code makes of it, such as SystemError with that cause.

    Example: `is_interrupt(KeyboardInterrupt())` is True.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


@contextmanager
def put_off_interrupts() -> Iterator[None]:
    """Put Ctrl-C off to the end of a block."""
    handle = _usual_handler()
    if handle is None:
        yield
        return
    frames: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda _, frame: frames.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handle)
    if frames:
        handle(signal.SIGINT, frames[-1])


def _usual_handler() -> Handler | None:
    """What Ctrl-C does now; None outside the main thread, and where it is ignored."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        return None
    return handler


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
                raise _refusal(path, error) from error
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
            raise _refusal(path, error) from error
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


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for a block of files that are not kept. Raises InputError where they cannot be written."""
    import tempfile  # where something is compiled

    try:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)
    except OSError as error:
        raise _refusal(Path(tempfile.gettempdir()), error) from error


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


def _refusal(path: Path, error: OSError | ValueError) -> InputError:
    reason = getattr(error, "strerror", None) or str(error)
    blamed = getattr(error, "filename", None)
    if blamed and Path(blamed) in path.parents:
        reason += f" ({blamed})"
    return InputError(path, "", reason, "a place to write the file to")
