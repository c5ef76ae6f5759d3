"""Worker processes that follow the newest design: each is asked, superseded, and ended where it does not give way."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from malta.errors import CheckError, InputError
from malta.processes import environment, python_module

PATIENCE = 1.5  # s, from a newer design to the end of a process that still works on an older one

Hear = Callable[[dict[str, Any]], None]


class Worker:
    """A process `malta.app.worker`, which works on the newest document it was sent.

    A process that dies at a document is started again and asked once more; where that one dies too, its answer is that.

    hear : called from a thread with each document that the process answers
    """

    def __init__(self, hear: Hear) -> None:
        self._hear = hear
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._asked: Mapping[str, Any] = {}
        self._begun, self._ended, self._died = -1, -1, -1  # serials: begun with, answered, asked again
        self._closed = False

    def ask(self, message: Mapping[str, Any]) -> None:
        """Send a document; whatever the process works on is superseded."""
        with self._lock:
            if self._closed:
                return
            self._asked = message
            self._send()
        watch = threading.Timer(PATIENCE, self._end_if_stuck, (message["serial"],))
        watch.daemon = True
        watch.start()

    def close(self) -> None:
        """End the process."""
        with self._lock:
            self._closed = True
            self._end()

    def _send(self) -> None:
        if self._process is None or self._process.poll() is not None:
            self._process = _start()
            threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()
        assert self._process.stdin is not None
        with suppress(OSError):  # the process is gone: the next document starts another
            self._process.stdin.write(json.dumps(self._asked) + "\n")
            self._process.stdin.flush()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with suppress(ValueError):  # the stream was closed, or its last line is half of one
            for line in process.stdout:
                reply = json.loads(line)
                if reply["kind"] == "begin":
                    self._begun = reply["serial"]
                elif reply["kind"] == "end":
                    self._ended = reply["serial"]
                else:
                    self._hear(reply)
        self._bury(process)

    def _bury(self, process: subprocess.Popen[str]) -> None:
        """Start a process that ended by itself again and ask once more; say where the second one ends as well."""
        with self._lock:
            if self._process is not process or self._closed:
                return
            serial = self._asked["serial"]
            self._end()
            self._begun = -1
            if self._ended == serial:
                return
            again, self._died = self._died != serial, serial
            asked = self._asked
            if again:
                self._send()
        self._hear(_obituary(asked, _describe_end(process.returncode), again=again))

    def _end_if_stuck(self, serial: int) -> None:
        """End a process that has not begun with the newest document, unless it is only starting up, and ask anew."""
        with self._lock:
            newest = self._asked.get("serial") == serial and not self._closed
            if newest and 0 <= self._begun < serial:
                self._end()
                self._begun = -1
                self._send()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            with suppress(OSError):
                process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with suppress(OSError):
                        stream.close()


def _start() -> subprocess.Popen[str]:
    return subprocess.Popen(
        python_module("malta.app.worker"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,  # of answers alone; what a machine's module prints goes where the server's errors go
        text=True,
        encoding="utf-8",
        env=environment(OPENBLAS_NUM_THREADS="1"),
        start_new_session=True,  # Ctrl-C in the terminal is the server's
    )


FOLLOWER_TEXTS = {
    "prove": "proves the margin",
    "map": "draws the margin map",
    "tune": "tunes",
    "front": "computes the front",
    "stop": "tunes",
}


def _obituary(asked: Mapping[str, Any], reason: str, *, again: bool) -> dict[str, Any]:
    """What is heard of a process that ended at a document. again : it was started again and asked once more"""
    does = FOLLOWER_TEXTS.get(asked["task"], "simulates and judges the requirements")
    sentence = f"the process that {does} ended by itself ({reason})"
    mark = {"version": asked["version"], "serial": asked["serial"]}
    if again:
        return mark | {"kind": "notice", "text": f"{sentence}: it was started again and asked once more"}
    sentence += ", and so did the one that was started in its place"
    return mark | failed_document(asked["task"], sentence)


def _describe_end(code: int) -> str:
    """How a process ended, for a reader who did not end it."""
    if code == -signal.SIGKILL:
        return "it was killed, as a computer does that has no memory left"
    if code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


# What goes wrong behind the page, in one sentence: a page has no place for a traceback.


def describe_error(error: Exception) -> str:
    """The sentence of an error; of one that malta does not raise on purpose, its kind and text as well."""
    if isinstance(error, InputError | CheckError):
        return str(error)
    if isinstance(error, ArithmeticError):
        return f"numbers beyond what can be computed ({error})"
    if isinstance(error, MemoryError):
        return "more was asked for than this computer has memory for"
    return f"a defect of malta or of the machine's module: {type(error).__name__} ({error})"


def failed_document(task: str, sentence: str) -> dict[str, Any]:
    """What ended a task of the worker in a sentence: nothing is proven then, nothing more is found."""
    if task == "prove":
        return {"kind": "proof", "lower": None, "upper": None, "frequency": None, "reason": sentence}
    if task in ("tune", "front"):
        return {"kind": "searched", "of": task, "error": sentence}
    return {"kind": "map" if task == "map" else "failed", "error": sentence}
