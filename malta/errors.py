"""The two ways in which malta says no: the input is wrong, or the answer is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

MAX_SENTENCE_LENGTH = 300  # characters of a sentence
MOST_OF_FILE, MOST_OF_FIELD = 150, 60  # characters of it that name the file and the field


def on_one_line(text: str) -> str:
    """A text in one printable line, whatever a key or a library's message holds."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))


def shorten(text: str, most: int = MAX_SENTENCE_LENGTH, *, head: float = 0.75) -> str:
    """A text in one line of at most `most` characters; dots stand for what is left out behind a share `head` of them.

    >>> shorten("expected one of m K_A K_B K_D l_B", 25)
    'expected one of ..._D l_B'
    """
    line = on_one_line(text)
    if len(line) <= most:
        return line
    begin = int(head * (most - 3))
    return f"{line[:begin]}...{line[len(line) - (most - 3 - begin) :]}"


class InputError(ValueError):
    """Input that cannot be used: one sentence with file, field, what was found and what was expected.

    The sentence has at most 300 characters: what is longer is cut in its middle. The command line prints it without a
    traceback and exits with code 2. Where one of several names is expected, the one that is most like what was typed is
    asked for: did you mean 'table2'?

    where : the file, or the function
    field : the entry or the argument
    found : what stands there
    expected : what should
    among : names of which one was meant, where `expected` does not list them as "one of ..."

    >>> import malta
    >>> try:
    ...     malta.read("data/tubular.toml", preset="table9")
    ... except malta.InputError as error:
    ...     print(error.field, error.found, sep=": ")
    presets: no preset 'table9'
    """

    def __init__(
        self, where: str | Path, field: str, found: str, expected: str, among: Iterable[str] = ()
    ) -> None:
        self.where, self.field = str(where), field
        file = shorten(self.where, MOST_OF_FILE, head=0.25)
        subject = ": ".join(filter(None, (file, shorten(field, MOST_OF_FIELD))))
        hint = _suggestion(field, found, list(among) or _names_in(expected))
        room = MAX_SENTENCE_LENGTH - len(f"{subject}: found , expected {hint}")
        whole = len(on_one_line(expected))
        self.found = shorten(found, max(room // 2, room - whole))
        self.expected = shorten(expected, room - len(self.found))
        super().__init__(f"{subject}: found {self.found}, expected {self.expected}{hint}")


def require_known(
    names: Iterable[str], known: Iterable[str], where: str | Path, field: str = "{}", found: str = ""
) -> None:
    """Raise InputError unless all names are known ones.

    field, found : of the sentence, in which {} stands for the name; "": the name itself is what was found

    >>> require_known(["Kp", "Kq"], ["Kp", "Ki"], "design.toml", "pid.{}", "an unknown gain")
    Traceback (most recent call last):
    malta.errors.InputError: design.toml: pid.Kq: found an unknown gain, expected one of Kp Ki
    """
    listed = list(dict.fromkeys(known))
    for name in names:
        if name not in listed:
            words = found.replace("{}", name) or repr(name)
            raise InputError(where, field.replace("{}", name), words, f"one of {' '.join(listed) or 'none'}")


@contextmanager
def relocate_errors(where: str | Path, field: str = "{}") -> Iterator[None]:
    """Within the block an InputError names this file or function, and this field, where {} stands for its own."""
    try:
        yield
    except InputError as error:
        own = field.replace("{}", error.field)
        raise InputError(where, own, error.found, error.expected) from error


def _names_in(expected: str) -> list[str]:
    """The names that a sentence lists: "c or fmu", "all, or one of x y", "one of bases.state: x y, or a number"."""
    if re.fullmatch(r"[\w-]+( or [\w-]+)+", expected):
        return expected.split(" or ")
    listed = re.search(r"\b(?:one|some) of (?:[\w.]+: )?(.*)", " ".join(expected.split()))
    if listed is None:
        return re.findall(r"'([^']+)'", expected) if expected.startswith("'") else []
    names = listed[1].partition(", or ")[0].replace("'", "").replace(" or ", ", ")
    return names.split(", ") if ", " in names else names.split()


def _suggestion(field: str, found: str, names: Sequence[str]) -> str:
    """The question that ends a refusal, where one of the expected names is like the one that was typed."""
    if not names:
        return ""
    from difflib import SequenceMatcher, get_close_matches  # where something is wrong already

    known = {name.lower(): name for name in reversed(names)}  # the first of those that differ in case alone
    likely: dict[str, float] = {}
    for whole in re.findall(r"'([^']+)'", found) or [field]:
        for typed in {whole, *(re.split(mark, whole)[-1] for mark in (r"[.:] ?", r"[.:]? "))} - set(names):
            for name in get_close_matches(typed.lower(), known, n=1):
                likely[known[name]] = SequenceMatcher(None, name, typed.lower()).ratio()
    return f" (did you mean {max(likely, key=lambda name: likely[name])!r}?)" if likely else ""


class CheckError(ArithmeticError):
    """A result that failed its own check (residual, stability, symmetry); nothing is written then.

    The command line prints its sentence and exits with code 1.

    >>> import malta
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [0]], [[1, 0]])  # B = 0
    >>> model = malta.linearize(cart, cart.at())
    >>> try:
    ...     malta.synthesis.lqr(model, malta.synthesis.weights([1, 1], [1], [1], [1]))
    ... except malta.CheckError as error:
    ...     print(str(error).partition(" (")[0])
    LQR: no stabilizing solution
    """
