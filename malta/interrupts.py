"""Ctrl-C: noted where libraries may drop the KeyboardInterrupt, and put off where files are renamed into place."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any]


@contextmanager
def watch_interrupts(*kept: type[BaseException]) -> Iterator[list[float]]:
    """Note when Ctrl-C was pressed (s, monotonic), and let it raise as usual; nothing is noted outside the main thread.

    Libraries may drop the KeyboardInterrupt: whoever watches can raise it again. Or they make an error of their own of
    it, as CasADi does, which says that an argument is of another type: that becomes the KeyboardInterrupt again.

    kept : errors that stand as they are
    """
    pressed: list[float] = []
    handle = _usual_handler()
    if handle is None:
        yield pressed
        return
    thrown: list[float] = []

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(time.monotonic())
        try:
            handle(number, frame)
        except KeyboardInterrupt:
            thrown.append(pressed[-1])
            raise

    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    except kept:
        raise
    except Exception as error:
        if not thrown:
            raise
        raise KeyboardInterrupt from error
    finally:
        signal.signal(signal.SIGINT, handle)


@contextmanager
def soften_first_interrupt(end: Callable[[], None]) -> Iterator[None]:
    """Let the first Ctrl-C call `end`, which asks the work to end by itself, and further ones raise as usual."""
    handle = _usual_handler()
    if handle is None:
        yield
        return
    usual, asked = handle, list[int]()

    def ask(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        if len(asked) > 1:
            usual(number, frame)
        end()

    signal.signal(signal.SIGINT, ask)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def press_again() -> None:
    """Press Ctrl-C for the main thread, also where it waits."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)


def is_interrupt(error: BaseException) -> bool:
    """Whether an error is Ctrl-C: KeyboardInterrupt, or what C code makes of it, such as SystemError with that cause.

    Example: `is_interrupt(KeyboardInterrupt())` is True.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


@contextmanager
def put_off_interrupts() -> Iterator[None]:
    """Put Ctrl-C off to the end of a block."""
    handle = _usual_handler()
    if handle is None:
        yield
        return
    frames: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda _, frame: frames.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handle)
    if frames:
        handle(signal.SIGINT, frames[-1])


def _usual_handler() -> Handler | None:
    """What Ctrl-C does now; None outside the main thread, and where it is ignored."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        return None
    return handler
