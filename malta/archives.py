"""A strict reader of .npz archives: stored arrays of numbers and text, as gain files, logs and campaigns have them.

Members are stored, so an archive never holds more than its own bytes. Every declared size is compared with those bytes
before an array is made: no archive takes more memory than a small multiple of its file.

Sources: PKWARE, APPNOTE.TXT (.zip); NumPy Enhancement Proposal 1 (.npy).
"""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np

MANY = 2000  # members; a gain file has about 60
ENTRY = b"PK\x01\x02"  # opens the entry of a member in the table of an archive
SUFFIX = ".npy"
KINDS = "biufcU"  # of arrays: truth values, numbers, text
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npz(data: bytes) -> dict[str, Any]:
    """Read the arrays of an .npz archive by name; they are read-only.

    Raises ValueError for damage and for what numpy.savez does not write of such arrays: compressed or encrypted
    members, two of one name, objects, arrays of another size than their member.

    >>> buffer = io.BytesIO()
    >>> np.savez(buffer, t=np.array([0.0, 0.5]))
    >>> read_npz(buffer.getvalue())["t"].tolist()
    [0.0, 0.5]
    """
    try:
        return _arrays(data)
    except ValueError:
        raise
    except Exception as error:  # a damaged archive makes zipfile raise nearly anything
        raise ValueError(f"a damaged archive: {str(error)[:120]}") from error


def _arrays(data: bytes) -> dict[str, Any]:
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("no archive: damage, a pickle or a file of another kind")
    if data.count(ENTRY) > MANY:  # before zipfile makes a record of each
        raise ValueError(f"an archive of more than {MANY} members")
    arrays: dict[str, Any] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > len(data):
            raise ValueError("members that are compressed or overlap, where numpy.savez stores them")
        for member in members:
            name = member.filename.removesuffix(SUFFIX)
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{name} is compressed, where numpy.savez stores it")
            if name in arrays or not member.filename.endswith(SUFFIX):
                raise ValueError(f"{name} stands twice" if name in arrays else f"{name} is no array")
            arrays[name] = _array(archive.read(member), name)
    return arrays


def _array(content: bytes, name: str) -> Any:
    """The array of a member, whose header declares as many bytes as follow it."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"{name} has the version {version} of its format")
    shape, columns_first, kind = HEADERS[version](file)
    left = len(content) - file.tell()
    if kind.hasobject:
        raise ValueError(f"{name} is an array of objects, which allow_pickle=False refuses")
    if kind.kind not in KINDS or not kind.itemsize:
        raise ValueError(f"{name} is an array of {kind}")
    # An array of no bytes may have a long side: it must not become a long list of empty ones.
    if math.prod(shape) * kind.itemsize != left or max(shape, default=0) > len(content):
        raise ValueError(f"{name} declares {shape} entries of {kind.itemsize} bytes where {left} follow")
    order: Any = "F" if columns_first else "C"
    return np.ndarray(shape, kind, buffer=content, offset=file.tell(), order=order)
