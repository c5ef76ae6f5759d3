"""Moves of the live page: what a slider waits for, from the question by HTTP to the last byte of its answer."""

from __future__ import annotations

import http.client
import json
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from timing import Result

from malta.app.server import Server
from malta.app.session import Session
from malta.files import shipped_path

ASKED = 0.1  # s of processor time, of a move
MOVES = 25  # of a run; the first of each is left out, which traces the machine
CASES = {  # design file -> keys that are moved, a number of the law and one of the machine
    "design/robust.toml": ("bases.state.x", "machine.m"),
    "design/table2.toml": ("bases.state.x", "machine.m"),
    "design/robust_observer.toml": ("bases.state.x", "machine.K_D"),
    "design/tubular_pid.toml": ("pid.Kd.fx_B1", "machine.m"),
    "design/structured.toml": ("structure.elements.radial.Kd", "machine.m"),
    "design/halbach.toml": ("bases.state.x", "machine.m"),
    "design/halbach_pid.toml": ("pid.Kp.F_x", "machine.m"),
    "design/planar.toml": ("bases.integral.x", "machine.m", "machine.B_r"),
    "design/planar_pid.toml": ("pid.Kp.F_x", "machine.m"),
    "examples/rotor/design/rotor.toml": ("bases.state.x", "machine.m"),
}


class Moves(NamedTuple):
    """Seconds of each move: on the clock, and of this process's cores; of the parts that its answer leaves out."""

    wall: list[float]
    cpu: list[float]
    rest: list[float]


def live_page(runs: int) -> list[Result]:
    """Processor time of the first answer to moves of one number: the median and the 95th percentile beside what the
    page asks for."""
    rows = []
    for file, keys in CASES.items():
        for key in keys:
            seconds = moves(shipped_path(*file.split("/")), key, runs * MOVES)
            for name, share in (("median", 50), ("95 %", 95)):
                label = f"{Path(file).stem}, {key}, {name}"
                rows.append(
                    Result(label, float(np.percentile(seconds.cpu, share)), "asked for", ASKED, "at least 1")
                )
    return rows


def moves(design: Path, key: str, count: int) -> Moves:
    """Move one number of a design by small steps, and wait for each picture."""
    with tempfile.TemporaryDirectory() as scratch:
        session = Session(design, Path(scratch))
        with Server(session) as server:
            thread = threading.Thread(target=server.serve_forever, daemon=True)
            thread.start()
            connection = http.client.HTTPConnection("127.0.0.1", server.server_port)
            headers = {"X-Malta-Token": server.token, "Content-Type": "application/json"}
            value, found = session.files.fields[key].value, Moves([], [], [])
            assert isinstance(value, float | int)
            for number in range(count + 3):
                values = {key: value * (1 + 0.02 * np.sin(number + 1))}
                body = json.dumps({"ask": "evaluate", "number": number, "values": values})
                began, cpu = time.perf_counter(), time.process_time()
                connection.request("POST", "/ask", body, headers)
                answer = connection.getresponse().read()
                spent = time.perf_counter() - began, time.process_time() - cpu
                assert b'"poles"' in answer, answer[:300]
                connection.request("POST", "/ask", json.dumps({"ask": "rest", "number": number}), headers)
                connection.getresponse().read()
                if number > 2:
                    found.wall.append(spent[0])
                    found.cpu.append(spent[1])
                    found.rest.append(time.process_time() - cpu - spent[1])
            connection.close()
            server.shutdown()
            thread.join()
        session.close()
    return found


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for file, keys in CASES.items():
        for key in keys:
            found = moves(shipped_path(*file.split("/")), key, 2 * MOVES)
            ends = dict(
                zip(Moves._fields, (np.percentile(np.array(s) * 1e3, [50, 95]) for s in found), strict=True)
            )
            words = ", ".join(f"{name} {low:.0f} / {high:.0f}" for name, (low, high) in ends.items())
            print(f"{file} {key}: {words} ms (50 / 95 %)")
