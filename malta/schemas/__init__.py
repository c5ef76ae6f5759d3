"""JSON schemas of the files that malta reads, made of the tables that the readers check with.

    malta.schemas.schema("gain")            a gain file: .json, and what .npz and .mat hold
    malta.schemas.schema("design")          a design file, as TOML holds it
    malta.schemas.schema("data")            a machine's data file
    malta.schemas.schema("design", plant)   with the names of this machine's signals, parameters and requirements

An editor that has the schema of a file completes its keys and marks what the reader would refuse. A schema sees one
file: what depends on other files or on arithmetic (dimensions of units, shapes of matrices, stability) the reader
checks alone.
"""

from malta.schemas.files import SCHEMAS as SCHEMAS, schema as schema
