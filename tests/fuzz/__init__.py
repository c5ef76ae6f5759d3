"""Fuzzing: input of every kind, changed at random, has to be read or refused in one sentence.

    edits    what is changed: entries of a tree (a file's tables), bytes, both as plain data that print and shrink
    kinds    sound files of every kind, written with some edits and a seal of what they hold then, and read
    lines    command lines
    oracle   what reading may do: exit codes, one sentence, no warning, bounded time and memory, nothing left behind

`tests/test_fuzz.py` runs 2000 cases with a fixed seed; `make fuzz` goes on for as long as it is allowed to.
"""
