"""Archives of arrays: what numpy.savez writes is read, what would take time or memory is refused before it does."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refusal

import malta
from malta import gains
from malta.tables import read_npz


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def npy(shape: str, kind: str = "<f8", content: bytes = b"") -> bytes:
    """An array with the header that one declares."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def archive(*members: tuple[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as file:
        for name, content in members:
            file.writestr(name, content)
    return buffer.getvalue()


def bomb() -> bytes:
    """64 MB of zeros in 64 kB."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, t=np.zeros(8_000_000), y=np.zeros(2))
    return buffer.getvalue()


def overlapping() -> bytes:
    """An archive whose table names the same 800 kB a hundred times."""
    whole = bytearray(archive(("a.npy", npy("(100000,)", content=bytes(800_000)))))
    at = whole.index(b"PK\x01\x02")
    end = whole.rindex(b"PK\x05\x06")
    entry = bytes(whole[at:end])
    table = entry * 100
    tail = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 100, 100, len(table), at, 0)
    return bytes(whole[:at]) + table + tail


def test_arrays_are_those_that_numpy_wrote() -> None:
    arrays = {
        "text": np.array("compressed"),
        "names": np.array(["a", "µ"]),
        "matrix": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "nothing": np.zeros((0, 3)),
        "flags": np.array([True, False]),
        "count": np.array(7),
    }
    found = read_npz(npz(**arrays))
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (bomb(), "compressed or overlap"),
        (overlapping(), "compressed or overlap"),
        (archive(("t.npy", npz(t=np.arange(3))), compression=zipfile.ZIP_BZIP2), "compressed"),
        (archive(*((f"{k}.npy", b"") for k in range(2001))), "more than 2000 members"),
        (archive(("t.npy", npy("(1000000000000,)"))), "where 0 follow"),
        (archive(("t.npy", npy("(1000000000000, 0)"))), "where 0 follow"),
        (archive(("t.npy", npy("(2,)", content=bytes(15)))), "where 15 follow"),
        (archive(("t.npy", npy("(-1,)", content=bytes(8)))), "where 8 follow"),
        (archive(("t.npy", npy("(9,)", "<U0"))), "t is an array of <U0"),
        (archive(("t.npy", npy("(1,)", "|O", bytes(8)))), "an array of objects"),
        (archive(("t.npy", npy("(" + "1," * 9999 + ")"))), "is large"),
        (archive(("t.txt", b"text")), "no array"),
        (b"PK\x05\x06" + bytes(3), "no archive"),
        (npz(t=np.array([0.5])).replace(np.array([0.5]).tobytes(), bytes(8)), "damaged archive"),
        (b"", "no archive"),
    ],
    ids=range(15),
)
def test_other_archives_are_refused_before_they_take_memory(data: bytes, reason: str) -> None:
    tracemalloc.start()
    with pytest.raises(ValueError, match=reason):
        read_npz(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8e6  # a multiple of the 1 MB of the largest file, not of the 80 MB that it declares


@pytest.mark.slow
def test_bombs_are_refused_by_all_that_read_archives(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    path.write_bytes(bomb())
    assert "compressed" in refusal(lambda: gains.read(path), path).found
    refused = refusal(lambda: malta.identification.read_log(path), path)
    assert refused.expected == "an .npz archive of arrays"


def test_an_array_that_stands_twice_is_refused() -> None:
    """Readers would differ in which of the two they take."""
    with pytest.warns(UserWarning, match="Duplicate name"):
        data = archive(("t.npy", npy("(1,)", content=bytes(8))), ("t.npy", npy("(1,)", content=bytes(8))))
    with pytest.raises(ValueError, match="t stands twice"):
        read_npz(data)


@pytest.mark.parametrize("kind", ["<M8[s]", "<m8[s]", "|S8", "|V8"])
def test_arrays_of_neither_numbers_nor_text_are_refused(kind: str) -> None:
    with pytest.raises(ValueError, match="t is an array of "):
        read_npz(archive(("t.npy", npy("(1,)", kind, bytes(8)))))


def test_another_version_of_the_format_is_refused() -> None:
    data = npy("(1,)", content=bytes(8))
    with pytest.raises(ValueError, match=r"t has the version \(3, 0\) of its format"):
        read_npz(archive(("t.npy", data[:6] + b"\x03\x00" + data[8:])))
