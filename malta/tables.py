"""Strict readers: tables of TOML and JSON files, checked against pydantic models, and arrays of .npz archives."""

from __future__ import annotations

import io
import math
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field as Checked, StrictStr, ValidationError

from malta.errors import InputError
from malta.files import read_file

_Model = TypeVar("_Model", bound=BaseModel)
MAX_DEPTH = 30  # tables and lists in others; files of malta have 6 at most
Finite = Annotated[float, Checked(strict=True, allow_inf_nan=False)]
Positive = Annotated[Finite, Checked(gt=0)]


def entry(
    meaning: str, unit: str = "", *, shape: str = "", default: Any = ..., alias: str | None = None
) -> Any:
    """Declare an entry of a table: a field of its Record, with what schemas and pages say of it.

    meaning : what the entry holds, in words
    unit : SI unit of the number or of each number of the list; "" where the text or the machine says it
    shape : number of entries of a list, or rows x columns of a matrix, as "m x n"
    default : of an entry that may be left out; without one the entry has to stand in the file
    alias : key in the file, where it is no name of Python

    Example: `Kp: Positive = entry("proportional gain", "V/A")`
    """
    extra: dict[str, Any] = {key: value for key, value in (("unit", unit), ("shape", shape)) if value}
    return Checked(default, description=meaning, alias=alias, json_schema_extra=extra)


class Record(BaseModel):
    """One table of a file: immutable, without unknown keys; subclasses use strict types, which convert nothing."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Quantity(Record):
    """A number with its unit: `{ value = 0.36, unit = "kg" }`."""

    value: Finite = entry("number, in the unit beside it")
    unit: StrictStr = entry('unit of the right dimension, as "um" or "N s/m"')


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file. Raises InputError when the file is missing, unreadable, not text or not TOML."""
    text = read_file(Path(path), "TOML file", lambda p: p.read_text(encoding="utf-8"))
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, endless digits, endless nesting
        raise InputError(path, "", f"a TOML error ({error})", "a complete TOML file") from error
    require_shallow(content, path)
    return content


def require_shallow(content: object, where: str | Path) -> None:
    """Raise InputError for tables and lists in more than MAX_DEPTH others: what is done to each takes the stack."""
    level, depth = [content], 0
    while level:
        if depth > MAX_DEPTH:
            raise InputError(where, "", f"tables in more than {MAX_DEPTH} others", "the tables of its format")
        inner = (x.values() if isinstance(x, dict) else x for x in level if isinstance(x, dict | list))
        level, depth = [value for values in inner for value in values], depth + 1


def validate(model: type[_Model], content: object, where: str | Path) -> _Model:
    """Check `content` against a pydantic model. Raises InputError, which states the first fault in one sentence."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise explain(error, where, model) from error


def explain(error: ValidationError, where: str | Path, model: type[BaseModel] | None = None) -> InputError:
    """Turn the first fault that pydantic found into one sentence.

    where : the file that it names
    model : of the whole document, whose keys it names
    """
    errors = error.errors(include_url=False)
    first = errors[0]
    if first["type"] == "missing":  # a key that is typed wrong is both missing and unknown
        extra = (e for e in errors if e["type"] == "extra_forbidden" and e["loc"][:-1] == first["loc"][:-1])
        first = next(extra, first)
    name = ".".join(str(part) for part in first["loc"] if not str(part).startswith("function-"))
    kind, message = first["type"], first["msg"]
    if kind == "missing":
        return InputError(where, name, "nothing", "this key")
    if kind == "extra_forbidden":
        known = [] if model is None else _keys_at(model, first["loc"][:-1])
        return InputError(
            where,
            name,
            "an unknown key",
            f"one of {' '.join(known)}" if known else "only the keys of its format",
        )
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        quantity = first.get("ctx", {}).get("class_name") == "Quantity"
        message = 'a table with its unit, as { value = 200, unit = "us" }' if quantity else "a table"
    if kind == "string_pattern_mismatch":
        message = "a name of letters, digits, - and _"
    found = repr(first["input"])
    expected = message.removeprefix("Value error, ").removeprefix("Input should be ")
    return InputError(where, name, found if len(found) <= 60 else found[:57] + "...", expected)


def _keys_at(model: type[BaseModel], place: Sequence[int | str]) -> list[str]:
    """The keys of a table within a document of this model; none where the table is of several kinds."""
    at: Any = model
    for part in place:
        if not (isinstance(at, type) and issubclass(at, BaseModel)):
            break  # an entry of a mapping or of a list: `at` is what the entries are
        named = {field.alias or name: field.annotation for name, field in at.model_fields.items()}
        kinds = _models_in(named.get(str(part)))
        if len(kinds) != 1:
            return []
        at = kinds[0]
    return [field.alias or name for name, field in at.model_fields.items()]


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models of tables that an annotation speaks of, as Mapping[str, Quantity] | None of Quantity."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]


# Archives: stored arrays of numbers and text in .npz files, as gain files, logs and campaigns have them, read strictly.
#
# Members are stored, so an archive never holds more than its own bytes. Every declared size is compared with those
# bytes before an array is made: no archive takes more memory than a small multiple of its file.
#
# Sources: PKWARE, APPNOTE.TXT (.zip); NumPy Enhancement Proposal 1 (.npy).


MAX_MEMBERS = 2000  # members; a gain file has about 60
ENTRY = b"PK\x01\x02"  # opens the entry of a member in the table of an archive
SUFFIX = ".npy"
PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # how members may be: as of numpy.savez, savez_compressed
KINDS = "biufcU"  # of arrays: truth values, numbers, text
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(data: bytes, room: int = 0) -> dict[str, Any]:
    """Read the arrays of an .npz archive by name; they are read-only.

    room : bytes that all members may have where numpy.savez_compressed packed them; 0: none may be packed

    Raises ValueError for damage and for what numpy does not write of such arrays: encrypted members, two of one name,
    objects, arrays of another size than their member, or members of more bytes.

    >>> buffer = io.BytesIO()
    >>> np.savez(buffer, t=np.array([0.0, 0.5]))
    >>> read_npz(buffer.getvalue())["t"].tolist()
    [0.0, 0.5]
    """
    try:
        return _arrays(data, room)
    except ValueError:
        raise
    except Exception as error:  # a damaged archive makes zipfile raise nearly anything
        raise ValueError(f"a damaged archive: {str(error)[:120]}") from error


def _arrays(data: bytes, room: int) -> dict[str, Any]:
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("no archive: damage, a pickle or a file of another kind")
    if data.count(ENTRY) > MAX_MEMBERS:  # before zipfile makes a record of each
        raise ValueError(f"an archive of more than {MAX_MEMBERS} members")
    arrays: dict[str, Any] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > max(len(data), room):
            raise ValueError("members that are compressed or overlap, where numpy.savez stores them")
        for member in members:
            name = member.filename.removesuffix(SUFFIX)
            if member.compress_type not in PACKED[: 2 if room else 1]:
                raise ValueError(f"{name} is compressed, where numpy.savez stores it")
            if name in arrays or not member.filename.endswith(SUFFIX):
                raise ValueError(f"{name} stands twice" if name in arrays else f"{name} is no array")
            arrays[name] = _array(archive.read(member), name)
    return arrays


def _array(content: bytes, name: str) -> Any:
    """The array of a member, whose header declares as many bytes as follow it."""
    file = io.BytesIO(content)
    shape, columns_first, kind = _header(file, name)
    left = len(content) - file.tell()
    # An array of no bytes may have a long side: it must not become a long list of empty ones.
    if math.prod(shape) * kind.itemsize != left or max(shape, default=0) > len(content):
        raise ValueError(f"{name} declares {shape} entries of {kind.itemsize} bytes where {left} follow")
    order: Any = "F" if columns_first else "C"
    return np.ndarray(shape, kind, buffer=content, offset=file.tell(), order=order)


def _header(file: Any, name: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and kind of an array; the file stands at its numbers then. Raises ValueError for other arrays."""
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"{name} has the version {version} of its format")
    shape, columns_first, kind = HEADERS[version](file)
    if kind.hasobject:
        raise ValueError(f"{name} is an array of objects, which allow_pickle=False refuses")
    if kind.kind not in KINDS or not kind.itemsize:
        raise ValueError(f"{name} is an array of {kind}")
    return shape, columns_first, kind


class StoredArray(NamedTuple):
    """Where the numbers of an array stand in an archive that is not packed."""

    offset: int  # bytes from the begin of the file
    kind: np.dtype[Any]
    shape: tuple[int, ...]
    columns_first: bool


def locate_arrays(path: Path) -> dict[str, StoredArray] | None:
    """Where the arrays of a large .npz archive stand in their file, by name; None where some are packed.

    Checks what `read_npz` checks but for the sums of the members' bytes, which are not read. Raises ValueError.
    """
    found: dict[str, StoredArray] = {}
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS or any(m.compress_type != zipfile.ZIP_STORED for m in members):
                return None
            if sum(member.file_size for member in members) > path.stat().st_size:
                raise ValueError("members that overlap, where numpy.savez stores them")
            for member in members:
                name = member.filename.removesuffix(SUFFIX)
                if name in found or not member.filename.endswith(SUFFIX):
                    raise ValueError(f"{name} stands twice" if name in found else f"{name} is no array")
                found[name] = _locate(file, member, name)
    except ValueError:
        raise
    except Exception as error:  # as read_npz
        raise ValueError(f"a damaged archive: {str(error)[:120]}") from error
    return found


def _locate(file: Any, member: zipfile.ZipInfo, name: str) -> StoredArray:
    file.seek(member.header_offset)
    head = file.read(30)
    if head[:4] != b"PK\x03\x04":
        raise ValueError(f"{name} has no header where the archive says")
    begin = (
        member.header_offset
        + 30
        + int.from_bytes(head[26:28], "little")
        + int.from_bytes(head[28:30], "little")
    )
    file.seek(begin)
    shape, columns_first, kind = _header(file, name)
    left = begin + member.file_size - file.tell()
    if left != kind.itemsize * math.prod(shape):
        raise ValueError(f"{name} declares {shape} entries of {kind.itemsize} bytes where {left} follow")
    return StoredArray(file.tell(), kind, shape, columns_first)
