"""Fuzzing: input of every kind, changed at random, has to be read or refused in one sentence.

    edits    what is changed: entries of a tree (a file's tables), bytes, both as plain data that print and shrink
    cases    a sound file with some edits of its tables or bytes, and whether its seal is renewed
    gain_files, designs, records    sound files, written with their edits, and read
    kinds    all of them, with the number of cases that each one gets
    lines    command lines
    oracle   what reading may do: exit codes, one sentence, no warning, bounded time and memory, nothing left behind

`tests/project/test_fuzz.py` runs 2000 cases with a fixed seed; `make fuzz` goes on for as long as it is allowed to.
"""
