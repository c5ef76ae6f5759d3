"""Writing files: all or none, nothing half-written, nothing left behind. Reading them: no pipes, no end in sight."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import refusal

import malta
from malta.campaigns.store import read_manifest
from malta.files import read_file, scratch_folder
from malta.gains.certified import check
from malta.tables import load_toml
from malta.writing import replace_files, temporary_name, writer


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_files_are_written_and_replaced(tmp_path: Path) -> None:
    old, new = tmp_path / "old.bin", tmp_path / "new.bin"
    old.write_bytes(b"a longer content than the new one")
    replace_files({old: b"\x00\xff", new: b""})
    assert (old.read_bytes(), new.read_bytes()) == (b"\x00\xff", b"")
    assert names(tmp_path) == ["new.bin", "old.bin"]


def test_nothing_to_write_writes_nothing(tmp_path: Path) -> None:
    replace_files({})
    assert names(tmp_path) == []


def test_folders_are_made(tmp_path: Path) -> None:
    replace_files({tmp_path / "a" / "b" / "x.bin": b"1", tmp_path / "a" / "y.bin": b"2"})
    assert (tmp_path / "a" / "b" / "x.bin").read_bytes() == b"1"
    assert names(tmp_path / "a") == ["b", "y.bin"]
    assert names(tmp_path / "a" / "b") == ["x.bin"]


def test_relative_paths_are_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    replace_files({Path("x.bin"): b"1", Path("folder/y.bin"): b"2"})
    assert (tmp_path / "x.bin").read_bytes() + (tmp_path / "folder" / "y.bin").read_bytes() == b"12"


def test_files_may_be_read_by_everyone(tmp_path: Path) -> None:
    path = tmp_path / "x.bin"
    replace_files({path: b"1"})
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.skipif(os.name != "posix", reason="asks for a process by its number")
def test_what_killed_processes_left_is_removed(tmp_path: Path) -> None:
    """Of this computer, of a process that is gone, of the file that is written; nothing else."""
    ended = subprocess.Popen([sys.executable, "-S", "-c", ""])
    ended.wait()
    host, own = writer().rsplit(".", 1)
    left = tmp_path / f".a.json.{host}.{ended.pid}.0123abcd"
    others = [
        tmp_path / f".{name}.{process}.0123abcd"
        for name, process in (
            ("a.json", f"{host}.{own}"),
            ("a.json", f"elsewhere.{ended.pid}"),
            ("b.json", f"{host}.{ended.pid}"),
        )
    ]
    for file in (left, *others):
        file.touch()
    replace_files({tmp_path / "a.json": b"new"})
    assert not left.exists()
    assert all(file.exists() for file in others)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_one_place_that_cannot_be_written_to_leaves_all(tmp_path: Path, place: int) -> None:
    (tmp_path / "file").write_bytes(b"not a folder")
    old = tmp_path / "old.bin"
    old.write_bytes(b"old")
    paths = [old, tmp_path / "new.bin"]
    blocked = tmp_path / "file" / "x.bin"
    paths.insert(place, blocked)
    with pytest.raises(malta.InputError) as caught:
        replace_files(dict.fromkeys(paths, b"new"))
    assert str(caught.value).startswith(f"{blocked}: found ")
    assert caught.value.expected == "a place to write the file to"
    assert old.read_bytes() == b"old"
    assert names(tmp_path) == ["file", "old.bin"]
    assert (tmp_path / "file").read_bytes() == b"not a folder"


def test_folder_in_the_place_of_a_file_leaves_all(tmp_path: Path) -> None:
    old, folder = tmp_path / "old.bin", tmp_path / "folder.bin"
    old.write_bytes(b"old")
    folder.mkdir()
    message = re.escape(f"{folder}: found a folder of that name, expected a place")
    with pytest.raises(malta.InputError, match=message):
        replace_files({old: b"new", folder: b"new"})
    assert old.read_bytes() == b"old"
    assert names(tmp_path) == ["folder.bin", "old.bin"]


def test_name_that_is_too_long_is_refused(tmp_path: Path) -> None:
    with pytest.raises(malta.InputError, match=r"found File name too long, expected a place to write"):
        replace_files({tmp_path / "a.bin": b"1", tmp_path / ("b" * 300): b"2"})
    assert names(tmp_path) == []


def test_failure_while_writing_leaves_old_files_and_no_temporary_ones(tmp_path: Path) -> None:
    old = tmp_path / "old.bin"
    old.write_bytes(b"old")
    contents: dict[Path, bytes] = {old: b"new", tmp_path / "new.bin": "no bytes"}  # type: ignore[dict-item]
    with pytest.raises(TypeError, match="bytes-like"):
        replace_files(contents)
    assert old.read_bytes() == b"old"
    assert names(tmp_path) == ["old.bin"]


def test_full_disk_leaves_old_files_and_no_temporary_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Path, _: str) -> None:
        self.touch()
        raise OSError(28, "No space left on device")

    old = tmp_path / "old.bin"
    old.write_bytes(b"old")
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", full)
        with pytest.raises(
            malta.InputError, match=r"old\.bin: found No space left on device, expected a place"
        ):
            replace_files({old: b"new"})
    assert old.read_bytes() == b"old"
    assert names(tmp_path) == ["old.bin"]


def test_a_full_disk_of_temporary_files_is_named() -> None:
    with pytest.raises(malta.InputError, match=r"found No space left on device, expected a place"):  # noqa: SIM117
        with scratch_folder() as folder:
            raise OSError(28, "No space left on device")
    assert not folder.exists()


@pytest.mark.parametrize("failing", ["a.bin", "b.bin", "c.bin"])
def test_rename_that_fails_leaves_no_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    rename = Path.replace

    def refused(self: Path, target: Path) -> Path:
        if target.name == failing:
            raise PermissionError(13, "Permission denied", str(target))
        return rename(self, target)

    paths = [tmp_path / name for name in ("a.bin", "b.bin", "c.bin")]
    for path in paths:
        path.write_bytes(b"old")
    monkeypatch.setattr(Path, "replace", refused)
    blocked = tmp_path / failing
    with pytest.raises(malta.InputError, match=re.escape(f"{blocked}: found Permission denied")) as caught:
        replace_files(dict.fromkeys(paths, b"new"))
    assert caught.value.where == str(blocked)
    assert [path.read_bytes() for path in paths] == [b"old"] * 3
    assert names(tmp_path) == ["a.bin", "b.bin", "c.bin"]


def readers(path: Path) -> list[Callable[[], object]]:
    """All that reads a file which a user names."""
    return [
        lambda: load_toml(path),
        lambda: malta.read_design(path),
        lambda: malta.gains.read(path.with_suffix(".json")),
        lambda: malta.gains.read(path.with_suffix(".npz")),
        lambda: malta.gains.read(path.with_suffix(".mat")),
        lambda: malta.identification.read_log(path.with_suffix(".csv")),
        lambda: malta.identification.read_log(path.with_suffix(".npz")),
        lambda: read_manifest(path),
        lambda: check(path),
    ]


def test_pipes_and_devices_are_refused(tmp_path: Path) -> None:
    for kind, suffix in enumerate((".toml", ".json", ".npz", ".mat", ".csv")):
        os.mkfifo(tmp_path / f"pipe{suffix}")
        (tmp_path / f"device{suffix}").symlink_to("/dev/zero" if kind else "/dev/null")
    for stem in ("pipe", "device"):
        for read in readers(tmp_path / f"{stem}.toml"):
            with pytest.raises(malta.InputError, match="found a pipe or a device, expected a "):
                read()


def test_links_to_files_are_read(tmp_path: Path) -> None:
    (tmp_path / "file.toml").write_text("a = 1")
    (tmp_path / "link.toml").symlink_to(tmp_path / "file.toml")
    assert load_toml(tmp_path / "link.toml") == {"a": 1}


def test_files_without_end_are_refused(tmp_path: Path) -> None:
    for suffix in (".toml", ".json", ".npz", ".mat", ".csv"):
        with (tmp_path / f"large{suffix}").open("wb") as file:
            file.truncate(10**12)  # a sparse file
    for read in readers(tmp_path / "large.toml"):
        with pytest.raises(malta.InputError, match=r"found 1000000000000 bytes, expected a .* of at most "):
            read()


@pytest.mark.parametrize("key", ["a" + 2000 * ".a", "machine" + 2000 * ".a", "a" + 31 * ".a"])
def test_tables_in_countless_others_are_refused(tmp_path: Path, key: str) -> None:
    path = tmp_path / "deep.toml"
    path.write_text(f"{key} = 1\n")
    for read in (lambda: malta.read_design(path), lambda: malta.read(path)):
        with pytest.raises(
            malta.InputError, match=r"deep\.toml: found tables in more than 30 others, expected"
        ):
            read()


def test_lists_in_countless_others_are_refused_in_gain_files(tmp_path: Path) -> None:
    path = tmp_path / "deep.json"
    path.write_text('{"schema": ' + 500 * "[" + 500 * "]" + "}")
    with pytest.raises(malta.InputError, match=r"deep\.json: found tables in more than 30 others, expected"):
        malta.gains.read(path)


def test_temporary_names_are_of_a_computer_and_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two computers that share a volume may have processes of one number."""
    path = Path("folder/runs.npz")
    monkeypatch.setattr("os.getpid", lambda: 4711)
    names_of = []
    for host in ("one", "../other", "one"):
        monkeypatch.setattr("socket.gethostname", lambda host=host: host)
        names_of.append(temporary_name(path))
    assert {name.parent for name in names_of} == {path.parent}
    assert [name.name.rpartition(".")[0] for name in names_of] == [
        ".runs.npz.one.4711",
        ".runs.npz.___other.4711",
        ".runs.npz.one.4711",
    ]
    assert len(set(names_of)) == 3


def test_files_are_on_the_disk_before_they_are_renamed_and_names_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    sync, rename = os.fsync, Path.replace

    def note_sync(opened: int) -> None:
        done.append("folder" if stat.S_ISDIR(os.fstat(opened).st_mode) else "file")
        sync(opened)

    def note_rename(self: Path, target: Path) -> Path:
        done.append(f"rename {target.name}")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "replace", note_rename)
    replace_files({tmp_path / "a.bin": b"1", tmp_path / "b.bin": b"2"})
    assert done == ["file", "file", "rename a.bin", "rename b.bin", "folder"]


def test_pipe_in_the_place_of_a_file_stays(tmp_path: Path) -> None:
    pipe = tmp_path / "x.bin"
    os.mkfifo(pipe)
    with pytest.raises(malta.InputError, match=r"x\.bin: found a pipe or a device of that name, expected"):
        replace_files({pipe: b"1"})
    assert pipe.is_fifo()
    assert names(tmp_path) == ["x.bin"]


def test_a_reader_may_have_a_limit_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "block"
    path.write_bytes(b"0123456789")
    assert read_file(path, "block", Path.read_bytes, 10) == b"0123456789"
    error = refusal(lambda: read_file(path, "block", Path.read_bytes, 9), path)
    assert (error.found, error.expected) == ("10 bytes", "a block of at most 9")
