"""The reader of MAT-files against scipy's, which is the second opinion here, and against files made to break it."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refusal
from hypothesis import given, settings, strategies as st
from scipy.io import loadmat, savemat
from scipy.sparse import csc_array

from malta.errors import InputError
from malta.gains import encodings, encodings as mat
from malta.gains.encodings import (
    COMPRESSED_ELEMENT,
    MATRIX,
    MAX_DECOMPRESSED_BYTES,
    MAX_STRUCT_DEPTH,
    read_mat,
)

COMMITTED = sorted(Path("design/gains").glob("*.mat"))
SMALL = Path("design/gains/halbach_pid.mat")


def _second_opinion(data: bytes) -> dict[str, Any]:
    """What scipy reads: structs as tables, cells of text as lists, texts, and arrays."""

    def plain(value: Any) -> Any:
        if value.dtype.kind == "V":
            return {key: plain(value[key][0, 0]) for key in value.dtype.names or ()}
        if value.dtype == object:
            return [plain(entry) for entry in value.ravel()]
        return (str(value[0]) if value.size else "") if value.dtype.kind == "U" else value

    buffer: Any = io.BytesIO(data)
    content = loadmat(buffer, struct_as_record=True, mat_dtype=True)
    return {key: plain(value) for key, value in content.items() if not key.startswith("__")}


def _comparable(value: Any) -> Any:
    """Arrays as lists with type and shape; empty ones as such."""
    if isinstance(value, dict):
        return {key: _comparable(entry) for key, entry in value.items()}
    if isinstance(value, list | str):
        return value
    return (value.dtype.str, value.tolist()) if value.size else "an empty array"


def _assert_same(data: bytes) -> None:
    assert _comparable(read_mat(data)) == _comparable(_second_opinion(data))


def _saved(content: dict[str, Any], **options: Any) -> bytes:
    buffer: Any = io.BytesIO()
    chosen: dict[str, Any] = {"long_field_names": True, "oned_as": "row"}
    savemat(buffer, content, **chosen | options)
    return bytes(buffer.getvalue())


def _signed(data: bytes) -> bytes:
    """The same bytes under a header that has their sha256."""
    body = data[encodings.MAT_HEADER :]
    return encodings.mat_header(body) + body


# --- sound files ---


@pytest.mark.parametrize("path", COMMITTED, ids=[path.stem for path in COMMITTED])
@pytest.mark.parametrize("options", [{}, {"do_compression": True}, {"oned_as": "column"}], ids=str)
def test_every_gain_file_is_read_as_scipy_reads_it(
    path: Path, options: dict[str, Any], tmp_path: Path
) -> None:
    """As committed, and saved anew by scipy with other options: the same document as in the .json."""
    _assert_same(path.read_bytes())
    content = encodings.decode(path.with_suffix(".json"))
    cells = encodings.matlab_cells(encodings.columns_of(content))
    data = _signed(_saved(cells, **options))
    _assert_same(data)
    again = tmp_path / path.name
    again.write_bytes(data)
    assert encodings.decode(again) == encodings.decode(path) == encodings.columns_of(content)


NAMES = st.from_regex(r"[a-zA-Z][a-zA-Z0-9_]{0,30}", fullmatch=True)
TEXT = st.text(st.characters(max_codepoint=0xFFFF, exclude_categories=["Cs", "Cc"]), max_size=20)
MATRICES = st.tuples(st.integers(0, 4), st.integers(0, 4)).flatmap(
    lambda shape: st.lists(st.floats(), min_size=shape[0] * shape[1], max_size=shape[0] * shape[1]).map(
        lambda numbers: np.array(numbers, dtype=float).reshape(shape)
    )
)
LEAVES = (
    st.floats(allow_nan=False)
    | st.integers(-(2**31), 2**31)
    | TEXT.filter(lambda text: text == text.strip())
    | st.lists(st.text("abcxyzµ_[]", min_size=1, max_size=9), min_size=1, max_size=4).map(
        lambda texts: np.array(texts, dtype=object)
    )
    | MATRICES.filter(lambda matrix: not np.isnan(matrix).any())
)
TABLES = st.recursive(
    LEAVES, lambda inner: st.dictionaries(NAMES, inner, min_size=1, max_size=4), max_leaves=12
)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(content=st.dictionaries(NAMES, TABLES, min_size=1, max_size=4), compressed=st.booleans())
def test_whatever_scipy_writes_is_read_as_scipy_reads_it(
    content: dict[str, Any], *, compressed: bool
) -> None:
    _assert_same(_saved(content, do_compression=compressed))


def _element(kind: int, content: bytes) -> bytes:
    if 0 < len(content) <= 4 and kind not in (MATRIX, COMPRESSED_ELEMENT):
        return struct.pack("<I", len(content) << 16 | kind) + content.ljust(4, b"\0")
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def _array(
    of: int, rows: int, columns: int, *content: bytes, name: str = "", flags: int = 0, dims: bytes = b""
) -> bytes:
    head = _element(6, struct.pack("<II", of | flags, 0)) + _element(
        5, dims or struct.pack("<ii", rows, columns)
    )
    return _element(MATRIX, head + _element(1, name.encode()) + b"".join(content))


def _file(*arrays: bytes) -> bytes:
    return _signed(b" " * 116 + b"\0" * 8 + b"\x00\x01IM" + b"".join(arrays))


def _struct(*fields: tuple[str, bytes], name: str = "") -> bytes:
    names = b"".join(key.encode().ljust(32, b"\0") for key, _ in fields)
    parts = (_element(5, struct.pack("<i", 32)), _element(1, names), *(value for _, value in fields))
    return _array(2, 1, 1, *parts, name=name)


OTHERS = {
    "whole numbers in bytes": _array(6, 2, 2, _element(2, bytes([1, 2, 3, 250])), name="x"),
    "whole numbers in pairs of bytes": _array(6, 1, 2, _element(3, struct.pack("<2h", -5, 300)), name="x"),
    "single precision in double": _array(6, 1, 1, _element(7, struct.pack("<f", 0.5)), name="x"),
    "an integer": _array(14, 1, 1, _element(12, struct.pack("<q", 2**40)), name="x"),
    "text in pairs of bytes": _array(4, 1, 3, _element(4, "abc".encode("utf-16-le")), name="x"),
    "text in UTF-16": _array(4, 1, 3, _element(17, "aµc".encode("utf-16-le")), name="x"),
    "text in UTF-8": _array(4, 1, 3, _element(16, "aµc".encode()), name="x"),
    "no text": _array(4, 0, 0, _element(16, b""), name="x"),
    "no matrix in a struct": _struct(("a", _element(MATRIX, b"")), name="x"),
    "no numbers": _array(6, 0, 7, _element(9, b""), name="x"),
    "a struct of both": _struct(
        ("a", _array(6, 1, 1, _element(2, b"\7"))), ("b", _array(4, 1, 1, _element(4, b"b\0"))), name="x"
    ),
}


@pytest.mark.parametrize("array", OTHERS.values(), ids=OTHERS)
def test_what_matlab_and_octave_write_is_read_as_scipy_reads_it(array: bytes) -> None:
    """Numbers in the smallest type, text in 16 bits, and each of them compressed."""
    _assert_same(_file(array))
    packed = zlib.compress(array)
    compressed = struct.pack("<II", COMPRESSED_ELEMENT, len(packed)) + packed
    _assert_same(_file(compressed, array.replace(b"\1\0\1\0x", b"\1\0\1\0y")))


def test_text_beyond_16_bits_counts_as_it_is_stored() -> None:
    text = "a\N{MATHEMATICAL BOLD SMALL X}"
    wide, narrow = text.encode("utf-16-le"), text.encode()
    assert read_mat(_file(_array(4, 1, 3, _element(17, wide), name="x"))) == {"x": text}
    assert read_mat(_file(_array(4, 1, 2, _element(16, narrow), name="x"))) == {"x": text}


# --- files that are no gain files ---


def _deep(levels: int) -> bytes:
    value = _array(6, 1, 1, _element(9, struct.pack("<d", 1.0)))
    for _ in range(levels):
        value = _struct(("a", value))
    return _file(_struct(("a", value), name="x"))


def _packed(content: bytes) -> bytes:
    packed = zlib.compress(content)
    return struct.pack("<II", COMPRESSED_ELEMENT, len(packed)) + packed


ONE = _element(9, struct.pack("<d", 1.0))
NUMBER = _array(6, 1, 1, ONE, name="x")
REFUSED: dict[str, tuple[bytes, str]] = {
    "level 4": (
        _signed(_saved({"x": np.eye(20)}, format="4", long_field_names=False)),
        "none of a little-endian MAT-file of level 5",
    ),
    "big-endian": (_signed(b" " * 124 + b"\1\0MI" + NUMBER), "none of a little-endian MAT-file of level 5"),
    "HDF5": (_signed(b" " * 124 + b"\x00\x02IM" + NUMBER), "none of a little-endian MAT-file of level 5"),
    "no header": (_signed(b" " * 116), "none of a little-endian MAT-file of level 5"),
    "complex": (_signed(_saved({"x": np.eye(2) * 1j})), "complex, logical or global"),
    "logical": (_signed(_saved({"x": np.array([True])})), "complex, logical or global"),
    "sparse": (_signed(_saved({"x": csc_array(np.eye(3))})), "an array of class 5"),
    "three dimensions": (_signed(_saved({"x": np.ones((2, 2, 2))})), "in place of dimensions"),
    "two structs": (_signed(_saved({"x": np.zeros((1, 2), dtype=[("a", "f8")])})), "2 structs in one array"),
    "numbers in a cell": (
        _signed(_saved({"x": np.array([1.0, "a"], dtype=object)})),
        "a cell array with entries other than text",
    ),
    "two rows of text": (_signed(_saved({"x": np.array(["ab", "cd"])})), "text of 2 rows"),
    "a name twice": (_file(NUMBER, NUMBER), "x stands twice"),
    "an entry twice": (_file(_struct(("a", NUMBER), ("a", NUMBER), name="x")), "a stands twice"),
    "no name": (_file(_array(6, 1, 1, ONE)), "a matrix without a name"),
    "a name that is none": (_file(_array(6, 1, 1, ONE, name="x\n")), "the name 'x\\n'"),
    "an entry without a name": (_file(_struct(("", NUMBER), name="x")), "a name without letters"),
    "a name without end": (_file(_struct(("a" * 32, NUMBER), name="x")), "or without end"),
    "nothing at all": (_file(_element(MATRIX, b"")), "a matrix without a name"),
    "two arrays in a matrix": (_file(_array(6, 1, 1, ONE, ONE, name="x")), "more than one array"),
    "no array": (_file(_array(6, 1, 1, name="x")), "numbers of type 0"),
    "no matrix": (_file(ONE), "an element of type 9 in place of a matrix"),
    "half an element": (_file(NUMBER[:-8]), "an element of"),
    "half a tag": (_file(NUMBER, b"\0" * 4), "4 bytes in place of an element"),
    "negative dimensions": (_file(_array(6, -1, -1, ONE, name="x")), "-1 x -1 entries"),
    "negative columns": (_file(_array(6, 1, -1, ONE, name="x")), "1 x -1 entries"),
    "more numbers than entries": (
        _file(_array(6, 1, 1, _element(9, struct.pack("<dd", 1.0, 2.0)), name="x")),
        "16 bytes of numbers",
    ),
    "more text than entries": (
        _file(_array(4, 1, 1, _element(16, b"ab"), name="x")),
        "2 characters in place of",
    ),
    "names of another length": (
        _file(_array(2, 1, 1, _element(5, struct.pack("<i", 2)), _element(1, b"a\0b"), NUMBER, name="x")),
        "3 bytes of names of 2 bytes each",
    ),
    "large dimensions": (_file(_array(6, 2**31 - 1, 2**31 - 1, ONE, name="x")), "8 bytes of numbers"),
    "a large cell": (
        _file(_array(1, 2**31 - 1, 2**31 - 1, name="x")),
        "in place of an entry of a cell array",
    ),
    "long text": (_file(_array(4, 1, 2**31 - 1, _element(16, b"a"), name="x")), "1 characters in place of"),
    "text that is none": (_file(_array(4, 1, 1, _element(16, b"\xff"), name="x")), "'utf-8' codec"),
    "text beyond its end": (_file(_array(4, 1, 2, _element(16, b"a\0"), name="x")), "a null character"),
    "text of numbers": (_file(_array(4, 1, 1, ONE, name="x")), "text of 1 rows in an element of type 9"),
    "integers of doubles": (_file(_array(14, 1, 1, ONE, name="x")), "numbers of type 9 in an array of int64"),
    "a class that is none": (_file(_array(99, 1, 1, ONE, name="x")), "an array of class 99"),
    "names of no length": (
        _file(_array(2, 1, 1, _element(5, bytes(4)), _element(1, b"a"), NUMBER, name="x")),
        "1 bytes of names of 0 bytes each",
    ),
    "structs without end": (_deep(MAX_STRUCT_DEPTH + 1), f"more than {MAX_STRUCT_DEPTH} structs in structs"),
    "compressed twice": (_file(_packed(_packed(NUMBER))), "an element of type 15 in place of a matrix"),
    "two compressed in one": (_file(_packed(NUMBER + NUMBER)), "not one matrix"),
    "more after the compressed data": (
        _file(
            struct.pack("<II", COMPRESSED_ELEMENT, len(zlib.compress(NUMBER)) + 8)
            + zlib.compress(NUMBER)
            + NUMBER[:8]
        ),
        "a compressed element that is damaged",
    ),
    "a long name in a short element": (
        _file(_element(MATRIX, NUMBER[8:48] + struct.pack("<HH", 1, 5) + b"x\0\0\0" + ONE)),
        "an element of 5 bytes",
    ),
    "nothing compressed": (_file(_packed(b"")), "not one matrix"),
    "no compressed data": (
        _file(struct.pack("<II", COMPRESSED_ELEMENT, 8) + b"malta123"),
        "a compressed element that is damaged",
    ),
    "half of the compressed data": (
        _file(struct.pack("<II", COMPRESSED_ELEMENT, 20) + zlib.compress(NUMBER)[:20]),
        "a compressed element that is damaged",
    ),
}


@pytest.mark.parametrize(("data", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_gain_files_do_not_have_is_refused_in_a_sentence(
    tmp_path: Path, data: bytes, sentence: str
) -> None:
    path = tmp_path / "gains.mat"
    path.write_bytes(data)
    error = refusal(lambda: encodings.decode(path), path)
    assert sentence in error.found
    assert error.expected == "a complete .mat gain file"


def test_names_may_have_spaces() -> None:
    """As signals of a machine from plain matrices, whose bandwidths are listed by their names."""
    _assert_same(_file(_struct(("air gap", NUMBER), ("tilt (x)", NUMBER), name="x")))


def test_structs_may_be_as_deep_as_the_limit() -> None:
    assert "a" in read_mat(_deep(MAX_STRUCT_DEPTH - 2))["x"]


@pytest.mark.slow
def test_compressed_data_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one element and of all: what is beyond is not unpacked, and no memory is taken for it."""
    monkeypatch.setattr(mat, "MAX_DECOMPRESSED_BYTES", 4000)
    parts = [_packed(_array(6, 1, 1500, _element(1, bytes(1500)), name=name)) for name in "xyz"]
    assert set(read_mat(_file(*parts[:2]))) == {"x", "y"}
    for arrays in (parts, [_packed(_array(6, 1, 5000, _element(1, bytes(5000)), name="x"))]):
        with pytest.raises(ValueError, match="of more than 4000 bytes"):
            read_mat(_file(*arrays))
    monkeypatch.undo()
    unpacked = 4 * MAX_DECOMPRESSED_BYTES
    bomb = _file(_packed(_array(6, 1, unpacked, _element(1, bytes(unpacked)), name="x")))
    assert len(bomb) < unpacked / 900
    tracemalloc.start()
    with pytest.raises(ValueError, match=f"of more than {MAX_DECOMPRESSED_BYTES} bytes"):
        read_mat(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * MAX_DECOMPRESSED_BYTES


# --- files made to break a reader ---

EXTREMES = (0, 1, 7, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def _byte_edits(data: bytes, count: int) -> Iterator[bytes]:
    """Copies with one byte changed, behind the header."""
    rng = np.random.default_rng(7)
    for _ in range(count):
        edited, at = bytearray(data), int(rng.integers(116, len(data)))
        edited[at] ^= 1 << int(rng.integers(8)) if rng.random() < 0.5 else int(rng.integers(1, 256))
        yield bytes(edited)


def _word_edits(data: bytes, count: int) -> Iterator[bytes]:
    """Copies with one aligned word, as types, sizes and dimensions are, at an extreme."""
    rng = np.random.default_rng(8)
    for _ in range(count):
        edited, at = bytearray(data), 128 + 4 * int(rng.integers((len(data) - 128) // 4))
        edited[at : at + 4] = struct.pack("<I", int(rng.choice(EXTREMES)))
        yield bytes(edited)


def _cuts(data: bytes, count: int) -> Iterator[bytes]:
    """Copies with a piece left out, put in twice, or cut off."""
    rng = np.random.default_rng(9)
    for k in range(count):
        begin, end = sorted(int(x) for x in rng.integers(128, len(data), 2))
        yield (data[:begin] + data[end:], data[:end] + data[begin:], data[:begin])[k % 3]


EDITS: dict[str, Callable[[bytes, int], Iterator[bytes]]] = {
    "bytes": _byte_edits,
    "words": _word_edits,
    "pieces": _cuts,
}


def _compressed_copy() -> bytes:
    content = encodings.decode(SMALL.with_suffix(".json"))
    return _saved(encodings.matlab_cells(encodings.columns_of(content)), do_compression=True)


def _given(data: bytes, *_: Any) -> bytes:
    return data


def _is_read(path: Path) -> bool:
    """Whether a file is read; else it is refused in a sentence, and any other error fails the test."""
    try:
        return isinstance(encodings.decode(path), dict)
    except InputError as error:
        return not (error.found.startswith("a damaged or foreign file (") and str(error).isprintable())


@pytest.mark.slow
@pytest.mark.parametrize("kind", EDITS)
@pytest.mark.parametrize("compressed", [False, True])
def test_an_edited_file_is_read_or_refused(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch, *, compressed: bool
) -> None:
    """With the header's hash made anew: read or refused, in half a second of the processor, the memory of ten files."""
    data = _compressed_copy() if compressed else SMALL.read_bytes()
    path, answers, slowest = tmp_path / "gains.mat", {"read": 0, "refused": 0}, 0.0
    edits = [_signed(edited) for edited in EDITS[kind](data, 150)]
    tracemalloc.start()
    for edited in edits:
        monkeypatch.setattr(encodings, "read_file", partial(_given, edited))
        start = time.process_time()
        answers["read" if _is_read(path) else "refused"] += 1
        slowest = max(slowest, time.process_time() - start)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert answers["refused"] > 20
    assert answers["read"] > 20 or kind == "pieces" or compressed
    assert slowest < 0.5
    assert peak < 10 * len(SMALL.read_bytes())


@pytest.mark.slow
def test_edited_files_that_are_read_are_read_as_scipy_reads_them(tmp_path: Path) -> None:
    """In a process of its own, which scipy may crash: it does on files that are refused here."""
    data, accepted = SMALL.read_bytes(), 0
    for edited in (*_byte_edits(data, 300), *_word_edits(data, 300)):
        try:
            found = _comparable(read_mat(edited))
        except ValueError:
            continue
        (tmp_path / f"{accepted}.mat").write_bytes(edited)
        (tmp_path / f"{accepted}.txt").write_text(repr(found), encoding="utf-8")
        accepted += 1
    assert accepted > 100
    program = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_mat import _comparable, _second_opinion
for path in sorted(Path(sys.argv[1]).glob("*.mat")):
    found = repr(_comparable(_second_opinion(path.read_bytes())))
    assert found == path.with_suffix(".txt").read_text(encoding="utf-8"), path.name
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path), *sys.path],  # whose folders have this module
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
