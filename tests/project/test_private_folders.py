"""Compiled engines are loaded from private folders only: whoever else could write their files decides what runs."""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from malta.simulation.engine import compiled, compiled as private_folders
from malta.simulation.engine.compiled import is_private, open_private, process_folder

TEXT = "int answer(void) { return 42; }"
PLANTED = "int answer(void) { return 13; }"
needs_compiler = pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler")


@pytest.fixture(autouse=True)
def place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """A cache folder that is not there yet; temporary folders beside it; a umask that drops nothing."""
    before = os.umask(0)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir(0o700)
    private_folders._note.cache_clear()
    process_folder.cache_clear()
    yield tmp_path / "cache" / "malta"
    process_folder.cache_clear()
    os.umask(before)


def _answer(folder: Path, text: str = TEXT) -> int:
    lib = compiled.library(text, 1, folder)
    assert lib is not None
    return int(lib.answer())


def _planted(folder: Path) -> Path:
    """The file of TEXT's library in a private folder, with another library in it that is sound.

    Both are made elsewhere: the linker does not load a path of a process twice.
    """
    aside = folder.parent / f"{folder.name}-aside"
    names: list[Path] = []
    for part, text in (("one", TEXT), ("other", PLANTED)):
        _answer(aside / part, text)
        names += (aside / part).iterdir()
    open_private(folder)
    return names[1].rename(folder / names[0].name)


def _mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@needs_compiler
def test_folders_and_files_are_made_for_the_user_alone(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Whatever the umask: those on the way too."""
    assert _answer(place) == 42
    (file,) = place.iterdir()
    assert [_mode(path) for path in (place.parent, place, file)] == [0o700, 0o700, 0o600]
    before = file.stat().st_mtime_ns
    assert _answer(place) == 42
    assert file.stat().st_mtime_ns == before
    assert not caplog.messages


@needs_compiler
@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777, 0o1777])
def test_a_folder_that_others_may_write_to_is_not_used(
    place: Path, caplog: pytest.LogCaptureFixture, mode: int
) -> None:
    """What was planted there is not run, and stays; a folder in the temporary one serves. One sentence, once."""
    file = _planted(place)
    place.chmod(mode)
    planted = file.read_bytes()
    assert _answer(place) == 42
    assert _answer(place) == 42
    assert caplog.messages == [
        f"malta: {place}: found mode {mode:04o}, expected a private folder: engines are not loaded from it"
    ]
    assert file.read_bytes() == planted
    (other,) = place.parent.parent.glob("tmp/malta-*/*.so")
    assert (_mode(other), _mode(other.parent)) == (0o600, 0o700)


@needs_compiler
@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_a_folder_that_others_may_replace_is_not_used(
    place: Path, caplog: pytest.LogCaptureFixture, mode: int
) -> None:
    """They can write to the folder around it, and rename it; a sticky one, as /tmp, keeps it where it is."""
    _planted(place)
    place.parent.chmod(mode)
    assert _answer(place) == 42
    assert f"found mode {mode:04o} ({place.parent.resolve()})" in caplog.text
    place.parent.chmod(0o1777)
    assert open_private(place) == place.resolve()


@needs_compiler
def test_a_folder_of_somebody_else_is_not_used(
    place: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To another user, who is not the system's, this user's folders are somebody else's: one of the process serves."""
    file, mine = _planted(place), os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    (place.parent.parent / "tmp" / f"malta-{mine + 1}").mkdir(0o700)
    monkeypatch.setattr(private_folders, "_on_the_way", lambda _: ())
    assert _answer(place) == 42
    assert len(caplog.messages) == 2
    assert all(f"found one of user {mine}, expected a private folder" in text for text in caplog.messages)
    assert file.exists()
    (other,) = process_folder().glob("*.so")
    assert _mode(other.parent) == 0o700


@needs_compiler
def test_a_folder_below_somebody_elses_is_not_used(
    place: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system's own folders are on every way; those of a third are not trusted."""
    _planted(place)
    way, lstat = place.parent.resolve(), Path.lstat

    def seen(path: Path) -> Any:
        found = lstat(path)
        return _owned(found, os.getuid() + 1) if path == way else found

    monkeypatch.setattr(Path, "lstat", seen)
    assert _answer(place) == 42
    assert f"found one of user {os.getuid() + 1} ({way})" in caplog.text
    monkeypatch.setattr(Path, "lstat", lambda path: _owned(lstat(path), 0) if path == way else lstat(path))
    assert open_private(place) is not None


def _owned(status: os.stat_result, owner: int) -> os.stat_result:
    entries = list(status)
    entries[stat.ST_UID] = owner
    return os.stat_result(entries)


@needs_compiler
def test_a_link_to_a_folder_is_not_followed(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Neither the folder itself nor, where it leads to an open folder, a link on the way; a sound way is walked."""
    tmp = place.parent.parent
    _planted(tmp / "real")
    place.parent.mkdir(0o700)
    place.symlink_to(tmp / "real", target_is_directory=True)
    assert _answer(place) == 42
    assert f"{place}: found a symbolic link, expected a private folder" in caplog.text
    (tmp / "open").mkdir(0o777)
    (tmp / "way").symlink_to(tmp / "open", target_is_directory=True)
    assert open_private(tmp / "way" / "malta") is None
    assert f"found mode 0777 ({(tmp / 'open').resolve()})" in caplog.text
    (tmp / "open").chmod(0o755)
    assert open_private(tmp / "way" / "malta") == (tmp / "open" / "malta").resolve()


FILES = {
    "of the group": (lambda file: file.chmod(0o620), "mode 0620"),
    "of everyone": (lambda file: file.chmod(0o602), "mode 0602"),
    "a link": (lambda file: file.symlink_to(file.rename(file.with_suffix(".other"))), "no plain file"),
}


@needs_compiler
@pytest.mark.parametrize(("change", "fault"), FILES.values(), ids=FILES)
def test_a_file_that_others_may_write_is_made_anew(
    place: Path, caplog: pytest.LogCaptureFixture, change: Any, fault: str
) -> None:
    file = _planted(place)
    change(file)
    assert _answer(place) == 42
    assert caplog.messages == [
        f"malta: {file.resolve().parent / file.name}: found {fault}, expected a file that only you can write: "
        "it is made anew"
    ]
    assert not file.is_symlink()
    assert _mode(file) == 0o600


@needs_compiler
def test_a_file_of_somebody_else_is_made_anew(
    place: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, lstat = _planted(place), Path.lstat

    def seen(path: Path) -> Any:
        found = lstat(path)
        return _owned(found, os.getuid() + 1) if path.suffix == ".so" else found

    monkeypatch.setattr(Path, "lstat", seen)
    assert not is_private(file)
    assert _answer(place) == 42
    assert f"found one of user {os.getuid() + 1}, expected a file that only you can write" in caplog.text


@needs_compiler
def test_what_is_planted_would_run(place: Path) -> None:
    """The tests above are no use unless the planted library is one that loads: in a private folder it does."""
    _planted(place)
    assert _answer(place) == 13


def test_the_sentence_reaches_the_terminal_without_more(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("malta"), "propagate", False)
    private_folders._note("malta: one sentence")
    private_folders._note("malta: one sentence")
    assert capsys.readouterr().err == "malta: one sentence\n"
