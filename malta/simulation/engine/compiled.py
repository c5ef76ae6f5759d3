"""Shared libraries of control periods: the system's C compiler, the cache of its results, and calls into them.

The user's cache folder keeps a library under the SHA-256 of its text, the compiler, the options and the processor. If
others can write to that folder, one in the temporary folder serves, or else one of this process alone. Two processes
that compile the same text at once write to different names first, and the last rename wins.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import logging
import os
import platform
import shlex
import shutil
import signal
import stat
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.files import scratch_folder

# Folders that nobody else can write to: whoever writes a library's file decides what this process runs.
#
# A folder serves where it is the user's own and no symbolic link, and where only the user and the system can write to
# it or replace a folder on the way to it. A refusal is one sentence, printed once, and another folder serves instead.


FOREIGN_WRITE_MODE = stat.S_IWGRP | stat.S_IWOTH


def open_private(folder: Path) -> Path | None:
    """The real path of a folder, made with mode 0700 where it is missing; None for a folder that is not private.

    Raises OSError where the folder cannot be made.
    """
    _make(folder)
    own = folder.parent.resolve(strict=True) / folder.name
    for way in _on_the_way(own):
        fault = _fault(way.lstat(), (0, os.getuid()), sticky=True)
        if fault:
            _note(
                f"malta: {folder}: found {fault} ({way}), expected a private folder: engines are not kept in it"
            )
            return None
    status = own.lstat()
    fault = "a symbolic link" if stat.S_ISLNK(status.st_mode) else _fault(status, (os.getuid(),))
    if fault:
        _note(f"malta: {folder}: found {fault}, expected a private folder: engines are not loaded from it")
        return None
    return own


def is_private(file: Path) -> bool:
    """Whether a file in a private folder is there, is a plain file of the user's own, and only he can write to it."""
    try:
        status = file.lstat()
    except FileNotFoundError:
        return False
    plain = stat.S_ISREG(status.st_mode)
    fault = _fault(status, (os.getuid(),)) if plain else "no plain file"
    if fault:
        _note(f"malta: {file}: found {fault}, expected a file that only you can write: it is made anew")
    return not fault


@cache
def process_folder() -> Path:
    """A new folder that is deleted when the process ends. Raises OSError without any temporary folder."""
    folder = Path(tempfile.mkdtemp(prefix="malta-engines-"))  # of mode 0700
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _on_the_way(folder: Path) -> Sequence[Path]:
    """The folders around a folder: whoever can write to one of them can replace what is in it."""
    return folder.parents


def _make(folder: Path) -> None:
    """Make a folder and those on the way to it that are missing, all with mode 0700."""
    if not folder.parent.exists():
        _make(folder.parent)
    folder.mkdir(mode=0o700, exist_ok=True)


def _fault(status: os.stat_result, owners: tuple[int, ...], *, sticky: bool = False) -> str:
    """What lets others write: an owner that is none of `owners`, or the mode; "" for neither.

    sticky : in folders of that mode, as /tmp, others cannot replace what is not theirs
    """
    if status.st_uid not in owners:
        return f"one of user {status.st_uid}"
    if status.st_mode & FOREIGN_WRITE_MODE and not (sticky and status.st_mode & stat.S_ISVTX):
        return f"mode {stat.S_IMODE(status.st_mode):04o}"
    return ""


@cache
def _note(sentence: str) -> None:
    logging.getLogger("malta").warning(sentence)


PATIENCE = 300.0  # s for a compilation, which takes some seconds
FLAGS = (
    *("-std=gnu11", "-O2", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fschedule-insns", "-fsched-pressure", "-fPIC", "-shared"),
    "-fno-tree-slp-vectorize",  # which may compute a number twice, rounded in two ways: v != w then means nothing
)
GCC_FLAGS = ("-fschedule-insns", "-fsched-pressure")  # clang does not know them
CLANG_FLAGS = {"-ffp-contract=fast": "-ffp-contract=off"}  # clang contracts one lane otherwise than many
TARGET = ("-march=native", "-mtune=generic")  # tuned for a compiler's guess of a processor, text is slower


@cache
def compiler() -> tuple[str, ...] | None:
    """The system's C compiler, as a command: $CC (which may have options), or the first of cc, gcc and clang.

    Raises InputError for a $CC with a quotation mark that is not closed.
    """
    given = os.environ.get("CC", "")
    try:
        chosen = shlex.split(given)
    except ValueError as error:
        raise InputError("$CC", "", repr(given[:60]), "a command, as a shell takes it") from error
    for name, *options in [chosen] if chosen else [["cc"], ["gcc"], ["clang"]]:
        path = shutil.which(name)
        if path:
            return path, *options
    return None


def _features() -> list[str]:
    """Features of the first processor, as the system lists them; none where it does not."""
    with suppress(OSError), Path("/proc/cpuinfo").open(encoding="utf-8") as lines:
        return next((line.split() for line in lines if line.startswith("flags")), [])
    return []


@cache
def _processor() -> str:
    """Model and features of the processor, on which `-march=native` depends."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return "".join(sorted({x for x in lines if x.startswith(("flags", "model name", "Features"))}))
    return platform.processor() + platform.machine()


# Doubles of one register of the processor, or two of them: more make text that is compiled for four times as long and
# flies slower.
LANES = 8 if "avx512dq" in _features() else 4
MOST_LANES = 8  # blocks of runs are multiples of it, whatever the processor


@cache
def _version(cc: tuple[str, ...]) -> str | None:
    """What a compiler says of itself; None for one that does not answer."""
    found = _answer([*cc, "--version"])
    return None if found is None else found[1]


def _answer(command: list[str], seconds: float | None = None) -> tuple[int, str] | None:
    """A compiler's exit code and what it prints; None where it cannot be started, or is stopped after so long.

    seconds : None: PATIENCE
    """
    seconds = PATIENCE if seconds is None else seconds
    try:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            errors="replace",
            start_new_session=True,
        )
    except OSError:
        return None
    with process:
        try:
            printed, _ = process.communicate(timeout=seconds)
        except BaseException as error:  # also Ctrl-C, which does not reach a session of its own
            with suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)  # with the programs that it started
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            found = f"{command[0]} without an answer for {seconds:g} s"
            logging.getLogger("malta").warning(f"malta: found {found}, expected a C compiler")
            return None
    return process.returncode, str(printed)


def library(
    text: str | Callable[[], str],
    lanes: int,
    folder: Path | None = None,
    flags: tuple[str, ...] | None = None,
    key: str = "",
) -> ctypes.CDLL | None:
    """The library of a C text, from the cache folder or compiled now; None where no compiler can make it.

    text : a function makes it where no library with this key is kept
    key : that decides the text; "": the text itself
    """
    cc = compiler()
    version = None if cc is None else _version(cc)
    if cc is None or version is None:
        return None
    flags = FLAGS if flags is None else flags
    decides = key or (text if isinstance(text, str) else text())
    key = "\n".join([decides, str(lanes), *flags, *TARGET, *cc, version, _processor(), platform.platform()])
    name = f"{hashlib.sha256(key.encode()).hexdigest()}.so"
    for wanted in (folder or cache_folder(), _temporary_folder(), None):
        try:
            place = process_folder() if wanted is None else open_private(wanted)
            if place is None:
                continue
            path = place / name
            sound = is_private(path) and _is_intact(path)
            if not sound and not _compile(cc, text if isinstance(text, str) else text(), lanes, path, flags):
                return None
            return ctypes.CDLL(str(path))
        except OSError:
            continue
    return None


def _is_intact(path: Path) -> bool:
    """Whether a library ends with the hash of its content. Loading half of a file would end the process."""
    content = path.read_bytes()
    return len(content) > 32 and hashlib.sha256(content[:-32]).digest() == content[-32:]


def cache_folder() -> Path:
    """The folder of compiled engines. Deleting it costs seconds of compilation. A user without a home has another."""
    try:
        return platformdirs.user_cache_path("malta")
    except RuntimeError:  # neither $HOME nor an entry of the user in the system
        return _temporary_folder()


def _temporary_folder() -> Path:
    return Path(tempfile.gettempdir()) / f"malta-{os.getuid()}"


def _compile(cc: tuple[str, ...], text: str, lanes: int, path: Path, flags: tuple[str, ...]) -> bool:
    """Compile a text to `path`, whole or not at all; False where the compiler fails."""
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        c, so = Path(scratch) / "engine.c", Path(scratch) / "engine.so"
        c.write_text(text, encoding="utf-8")
        common = [CLANG_FLAGS.get(flag, flag) for flag in flags if flag not in GCC_FLAGS]
        for tried in ((*flags, *TARGET), (*common, *TARGET), common):
            found = _answer([*cc, *tried, f"-DLANES={lanes}", str(c), "-o", str(so), "-lm"])
            if found is None:
                return False
            if found[0] == 0:
                content = so.read_bytes()
                so.write_bytes(content + hashlib.sha256(content).digest())  # see _is_intact
                so.chmod(0o600)  # whatever the umask: see is_private
                so.replace(path)
                return True
    return False


def shared_library(
    files: Mapping[str, bytes],
    flags: tuple[str, ...],
    cc: tuple[str, ...] | None = None,
    seconds: float | None = None,
) -> bytes | None:
    """The shared library of C files by name, for all processors of a kind; None where no compiler can make it.

    cc : the compiler as a command; None: this system's, for its own kind
    seconds : that it may take; None: PATIENCE
    """
    cc = cc or compiler()
    if cc is None:
        return None
    with scratch_folder() as folder:
        for name, content in files.items():
            (folder / name).write_bytes(content)
        texts = [str(folder / name) for name in sorted(files) if name.endswith(".c")]
        made = folder / "library"
        found = _answer([*cc, *flags, *texts, "-o", str(made), "-lm"], seconds)
        return made.read_bytes() if found is not None and found[0] == 0 else None


def address_of(array: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def feedforward_table(z_grid: FloatArray, v0: FloatArray) -> FloatArray:
    """Rows of z, v0(z) and the slope of v0 up to the next row: the table that the engine interpolates."""
    slope = np.diff(v0, axis=0) / np.diff(z_grid)[:, None]
    return np.ascontiguousarray(np.hstack([z_grid[:, None], v0, np.vstack([slope, slope[-1:]])]))
