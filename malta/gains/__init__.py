"""Gain files: a controller and its margins in .json, .npz and .mat."""

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.gains.encodings import SUFFIXES as SUFFIXES
    from malta.gains.file import read as read
    from malta.gains.writing import (
        agrees as agrees,
        document as document,
        file_contents as file_contents,
        write as write,
    )

_NAMES = {
    "malta.gains.encodings": "SUFFIXES",
    "malta.gains.file": "read",
    "malta.gains.writing": "agrees document file_contents write",
}
__all__, __getattr__, __dir__ = contents(__name__, _NAMES)
