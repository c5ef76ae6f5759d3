"""Campaigns on a Dask scheduler of the loopback: the same bits as here, whoever dies on the way."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from conftest import one_sentence
from page_examples import without_progress

import malta
from malta.campaigns import dask as cluster
from malta.campaigns.dask import block_of, blocks, collect_blocks, require_malta, simulate_at_worker, task_of
from malta.campaigns.plan import Plan
from malta.campaigns.run import campaign
from malta.campaigns.store import fly
from malta.simulation.engine.digest import Batch

if TYPE_CHECKING:
    from conftest import Design

GAINS = "design/gains/calibrated.json"
MANY = 4096  # machines, in four blocks
NOBODY = "tcp://127.0.0.1:1"
QUICK: dict[str, Any] = {"fidelity": "force", "duration": 0.02, "rise": 3e-3}


@pytest.fixture(scope="module")
def plan(designs: dict[str, Design]) -> Plan:
    return Plan(designs["calibrated"].controller, "stroke", {"m": 0.2, "K_A": 0.1}, samples=24, options=QUICK)


class Loopback(NamedTuple):
    """A scheduler and two workers, each a process."""

    address: str
    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]]


@pytest.fixture
def loopback(tmp_path: Path) -> Iterator[Loopback]:
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    common = ("--scheduler-file", str(file), "--host", "127.0.0.1", "--no-dashboard")
    one = ("--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
    with ExitStack() as stack:

        def started(kind: str, *options: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *common, *options]
            log = stack.enter_context((tmp_path / f"{kind}.log").open("ab"))
            process = subprocess.Popen(
                command, stdout=log, stderr=log, env=os.environ | {"PYTHONWARNINGS": ""}
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        scheduler = started("scheduler", "--port", "0", "--dashboard-address", "127.0.0.1:0")
        workers = [started("worker", *one) for _ in range(2)]
        for _ in range(60_000):
            if file.exists() and file.read_text(encoding="utf-8").endswith("}"):
                break
            time.sleep(0.01)
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
        yield Loopback(address, scheduler, workers)


def _malta(folder: Path, samples: int, *options: str) -> subprocess.Popen[str]:
    box = (
        "--option",
        "fidelity=force",
        "--spread",
        "20%",
        "--sensor",
        "gain_x1=2%",
        "--option",
        "quantize=true",
    )
    command = [sys.executable, "-m", "malta", "campaign", GAINS, "--samples", str(samples), *box]
    command += ["--out", str(folder), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _wait_for_block(process: subprocess.Popen[str], folder: Path) -> None:
    for _ in range(60_000):
        if list(folder.glob("runs_*.npz")):
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    raise AssertionError("no block within ten minutes")


def _blocks(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("runs_*.npz"))}


@pytest.mark.slow
def test_a_worker_is_killed_and_then_the_scheduler(loopback: Loopback, tmp_path: Path) -> None:
    """Of two workers one is killed in the middle: bit for bit what this machine finds. Then the scheduler is killed in
    the middle of the same campaign: one sentence, blocks stand, and this machine flies what is left."""
    whole = _malta(tmp_path / "here", MANY)
    found = _malta(tmp_path / "there", MANY, "--cluster", loopback.address)
    _wait_for_block(found, tmp_path / "there")
    loopback.workers[0].kill()
    out, err = found.communicate(timeout=600)
    assert (found.returncode, without_progress(err)) == (0, "")
    assert out.startswith(f"{GAINS}: stroke, fidelity force, {MANY} of {MANY} machines\n")
    tables, _ = whole.communicate(timeout=600)
    assert whole.returncode == 0
    assert out == tables.replace(str(tmp_path / "here"), str(tmp_path / "there"))
    assert len(_blocks(tmp_path / "here")) == 4
    assert _blocks(tmp_path / "here") == _blocks(tmp_path / "there")

    cut = _malta(tmp_path / "cut", MANY, "--cluster", loopback.address)
    _wait_for_block(cut, tmp_path / "cut")
    loopback.scheduler.kill()
    out, err = cut.communicate(timeout=600)
    assert (cut.returncode, out) == (2, "")
    sentence = one_sentence(without_progress(err))
    assert "the connection lost" in sentence
    assert "it goes on with what is left" in sentence
    kept = _blocks(tmp_path / "cut")
    assert 0 < len(kept) < 4
    rest = _malta(tmp_path / "cut", MANY)
    rest.communicate(timeout=600)
    assert rest.returncode == 0
    assert _blocks(tmp_path / "cut") == _blocks(tmp_path / "here")


@pytest.mark.slow
@pytest.mark.parametrize("address", [NOBODY, "nonsense", ""])
def test_nobody_at_the_address_is_one_sentence(plan: Plan, tmp_path: Path, address: str) -> None:
    """And what was done before is not lost."""
    pytest.importorskip("distributed")
    campaign(replace(plan, samples=16), tmp_path, block=8)
    (tmp_path / "runs_00000008.npz").unlink()
    before = _blocks(tmp_path)
    with pytest.raises(malta.InputError, match="expected a Dask scheduler, as tcp://host:8786") as caught:
        campaign(replace(plan, samples=16), tmp_path, cluster=address)
    assert str(caught.value).isprintable()
    assert _blocks(tmp_path) == before


def test_what_is_done_needs_no_cluster(plan: Plan, tmp_path: Path) -> None:
    campaign(plan, tmp_path)
    assert campaign(plan, tmp_path, cluster=NOBODY).completed.all()


def test_without_the_extra_it_says_how_to_get_it(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(malta.InputError, match=r"pip install 'malta\[cluster\]'"):
        campaign(plan, cluster=NOBODY)


def test_what_a_worker_does_is_what_is_done_here(plan: Plan) -> None:
    task = task_of(plan, malta_version())
    block = simulate_at_worker(task, 8, 8)
    assert not isinstance(block, str)
    here = fly(plan, 8, 8)
    for name in Batch.__dataclass_fields__:
        assert np.array_equal(getattr(block[1], name), getattr(here.batch, name), equal_nan=True)
    again = task_of(replace(plan), malta_version())  # as it comes with the next block
    assert cluster.unpickle_plan(again) is cluster.unpickle_plan(task)


def malta_version() -> str:
    from importlib.metadata import version

    return version("malta")


def test_what_a_worker_refuses_comes_back_as_a_sentence(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    refused = simulate_at_worker(task_of(plan, "9"), 0, 8)
    with pytest.raises(malta.InputError, match=f"a worker: found malta {malta_version()}, expected malta 9"):
        block_of(NOBODY, _future(refused))

    def none(*_: Any, **__: Any) -> Any:
        raise malta.InputError("campaign", "m", "lead", "iron")

    monkeypatch.setattr(cluster, "fly", none)
    refused = simulate_at_worker(task_of(plan, malta_version()), 0, 8)
    with pytest.raises(malta.InputError, match="campaign: m: found lead, expected iron"):
        block_of(NOBODY, _future(refused))


def _clients_answers(worker: Any, scheduler: Any) -> Any:
    """A client whose worker and scheduler answer so, or with the exception, to every question."""

    def of_scheduler(*_: Any) -> Any:
        if isinstance(scheduler, Exception):
            raise scheduler
        return scheduler

    return SimpleNamespace(run=lambda *_, **__: {"tcp://w:1": worker}, run_on_scheduler=of_scheduler)


NO_MALTA = ModuleNotFoundError("No module named 'malta'")


@pytest.mark.parametrize(
    ("worker", "scheduler", "said"),
    [
        (
            NO_MALTA,
            "9",
            "--cluster: the worker tcp://w:1: found a Python without malta, expected malta 9 there",
        ),
        ("9", NO_MALTA, "--cluster: the scheduler: found a Python without malta, expected malta 9 there"),
        ("8", "9", "--cluster: the worker tcp://w:1: found malta 8, expected malta 9"),
    ],
)
def test_a_python_without_this_malta_is_named(worker: Any, scheduler: Any, said: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        require_malta(_clients_answers(worker, scheduler), "9")
    assert str(caught.value) == said


def test_who_is_lost_while_it_is_asked_is_no_failure() -> None:
    require_malta(_clients_answers(OSError("gone"), OSError("gone")), "9")


@pytest.mark.slow
def test_a_worker_of_a_python_without_malta_is_one_sentence(loopback: Loopback, tmp_path: Path) -> None:
    hidden = "import sys; sys.modules['malta'] = None; from distributed.cli.dask_worker import main; main()"
    own = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path))
    worker = subprocess.Popen([sys.executable, "-c", hidden, loopback.address, *own], stderr=subprocess.PIPE)
    try:
        assert worker.stderr is not None
        while b"Starting established connection" not in worker.stderr.readline():
            assert worker.poll() is None
        found = _malta(tmp_path / "there", 24, "--cluster", loopback.address)
        out, err = found.communicate(timeout=600)
    finally:
        worker.kill()
        worker.communicate()
    assert (found.returncode, out) == (2, "")
    assert re.fullmatch(
        r"malta: --cluster: the worker tcp://127.0.0.1:\d+: found a Python without malta, "
        rf"expected malta {re.escape(malta_version())} there",
        err.splitlines()[-1],  # after how far it is, on a busy computer
    )


def _future(result: Any, status: str = "finished") -> Any:
    return SimpleNamespace(status=status, result=lambda: result, exception=lambda: result)


def test_a_worker_that_fails_is_one_sentence() -> None:
    with pytest.raises(malta.InputError, match="found a worker that fails \\(ModuleNotFoundError: No module"):
        block_of(NOBODY, _future(ModuleNotFoundError("No module named 'malta'"), "error"))
    with pytest.raises(malta.InputError, match="found the connection lost"):
        block_of(NOBODY, _future(None, "cancelled"))


class _Idle:
    """A scheduler that nobody works for."""

    def submit(self, *_: Any, **__: Any) -> Any:
        return object()

    def nthreads(self) -> dict[str, int]:
        return {}

    def as_current(self) -> ExitStack:
        return ExitStack()


def test_a_scheduler_without_workers_is_not_waited_for_forever(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wait(*_: Any, **__: Any) -> Any:
        raise TimeoutError

    monkeypatch.setattr(cluster, "WAIT", 3.0)
    with pytest.raises(malta.InputError, match="found no workers, expected a scheduler with some"):
        list(collect_blocks(SimpleNamespace(wait=wait), _Idle(), NOBODY, plan, {0: 8}))


def test_nothing_left_asks_nobody(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_connect", lambda *_: SimpleNamespace(close=lambda **_: None))
    pytest.importorskip("distributed")
    assert list(blocks(NOBODY, plan, {})) == []
