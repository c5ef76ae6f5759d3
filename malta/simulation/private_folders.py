"""Folders that nobody else can write to: whoever writes a library's file decides what this process runs.

A folder serves where it is the user's own and no symbolic link, and where only the user and the system can write to it
or replace a folder on the way to it. A refusal is one sentence, printed once, and another folder serves instead.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

OTHERS = stat.S_IWGRP | stat.S_IWOTH


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
    if status.st_mode & OTHERS and not (sticky and status.st_mode & stat.S_ISVTX):
        return f"mode {stat.S_IMODE(status.st_mode):04o}"
    return ""


@cache
def _note(sentence: str) -> None:
    logging.getLogger("malta").warning(sentence)
