"""Gain files: a controller and its margins in .json, .npz and .mat."""

from malta.gains.file import SUFFIXES as SUFFIXES
from malta.gains.file import agrees as agrees
from malta.gains.file import document as document
from malta.gains.file import file_contents as file_contents
from malta.gains.file import read as read
from malta.gains.file import write as write
