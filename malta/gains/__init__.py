"""Gain files: a controller and its margins in .json, .npz and .mat."""

from malta.gains.file import (
    SUFFIXES as SUFFIXES,
    agrees as agrees,
    document as document,
    file_contents as file_contents,
    read as read,
    write as write,
)
