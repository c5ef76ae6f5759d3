"""Worker processes that follow the newest design: each is asked, superseded, and ended where it does not give way."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

PATIENCE = 1.5  # s, from a newer design to the end of a process that still works on an older one

Hear = Callable[[dict[str, Any]], None]


class Worker:
    """A process `malta.app.worker`, which works on the newest document it was sent.

    hear : called from a thread with each document that the process answers
    """

    def __init__(self, hear: Hear) -> None:
        self._hear = hear
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._asked: Mapping[str, Any] = {}
        self._begun = -1
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
        for line in process.stdout:
            reply = json.loads(line)
            if reply["kind"] == "begin":
                self._begun = reply["serial"]
            else:
                self._hear(reply)

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
        [sys.executable, "-m", "malta.app.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        encoding="utf-8",
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        start_new_session=True,  # Ctrl-C in the terminal is the server's
    )
