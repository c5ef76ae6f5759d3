"""Simulate the blocks of a campaign on a Dask cluster. Only this module imports dask.distributed, which is an extra."""

from __future__ import annotations

import logging
import pickle
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pkgutil import resolve_name
from threading import Thread
from typing import Any

from malta.campaigns.plan import Plan
from malta.campaigns.store import RunBlock, fly
from malta.errors import InputError
from malta.files import version
from malta.model.machines import load_sources, sources_of

ANSWER = 3.0  # s, within which a scheduler answers
BLOCKS_AHEAD = 4  # blocks under way for each thread of the workers
WAIT = 30.0  # s without any worker, after which the campaign stops


@dataclass(frozen=True)
class _PlanTask:
    """A plan as it is sent to a worker, which keeps the first copy.

    The text of the machine's modules is sent along for a machine of the user's own, of which the worker has no file.
    """

    identity: str
    version: str  # of malta
    machine: str
    sources: Mapping[str, str] = field(compare=False)  # of the machine's modules, by their names
    plan: bytes = field(compare=False)  # pickled: a worker loads the machine before it reads the plan


def blocks(address: str, plan: Plan, left: Mapping[int, int]) -> Iterator[tuple[int, RunBlock]]:
    """(first run, block) as workers finish them; the block of a worker that dies goes to another worker.

    left : first run -> number of runs

    Raises InputError when dask.distributed is not installed, nothing answers at the address, no worker comes, or a
    worker fails.
    """
    try:
        import distributed
    except ImportError as error:
        expected = "it installed: pip install 'malta[cluster]'"
        raise InputError("--cluster", "", f"no dask.distributed here ({error})", expected) from error
    dask: Any = distributed
    with _silence_loggers():
        client = _connect(dask, address)
        try:
            if left:
                require_malta(client, version())
            yield from collect_blocks(dask, client, address, plan, left)
        finally:
            client.close(timeout=2)


def collect_blocks(
    dask: Any, client: Any, address: str, plan: Plan, left: Mapping[int, int]
) -> Iterator[tuple[int, RunBlock]]:
    task = task_of(plan, version())
    parts, alone = deque(left.items()), 0.0  # s
    waiting: dict[Any, int] = {}
    while waiting or parts:
        room = BLOCKS_AHEAD * max(_threads(client), 1) - len(waiting)
        try:
            # Few at a time: a block that is done stays in the memory of its worker until it is fetched.
            for part in [parts.popleft() for _ in range(min(len(parts), room))]:
                waiting[client.submit(simulate_at_worker, task, *part, pure=False)] = part[0]
            with client.as_current():
                done = dask.wait(list(waiting), timeout=1.0, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            alone = 0.0 if _threads(client) else alone + 1.0
            if alone >= WAIT:
                raise InputError("--cluster", address, "no workers", "a scheduler with some") from None
            continue
        except Exception as error:  # the scheduler is gone, and with it the blocks that were under way
            raise InputError(
                "--cluster", address, f"the connection lost ({type(error).__name__})", RESUME_HINT
            ) from error
        for future in done:
            yield waiting.pop(future), block_of(address, future)


def task_of(plan: Plan, malta: str) -> _PlanTask:
    name = plan.plant.name
    return _PlanTask(plan.identity, malta, name, sources_of(name), pickle.dumps(plan))


RESUME_HINT = "the same command once more: it goes on with what is left"


@contextmanager
def _silence_loggers() -> Iterator[None]:
    """Silence the library's loggers: a lost worker is no failure here, and every failure becomes one sentence."""
    loggers = [
        logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith("distributed")
    ]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def require_malta(client: Any, expected: str) -> None:
    """Raise InputError where the scheduler or a worker has no malta, or another version than the `expected` one.

    The questions are functions of the standard library: any Python can answer. Who is lost meanwhile is no failure.
    """
    for question, name in ((resolve_name, "malta.campaigns:__doc__"), (metadata.version, "malta")):
        for who, answer in _ask_all(client, question, name).items():
            if isinstance(answer, ImportError):  # PackageNotFoundError is one
                raise InputError("--cluster", who, "a Python without malta", f"malta {expected} there")
            if question is metadata.version and answer != expected and isinstance(answer, str):
                raise InputError("--cluster", who, f"malta {answer}", f"malta {expected}")


def _ask_all(client: Any, question: Callable[[str], Any], name: str) -> dict[str, Any]:
    """The answers of the scheduler and of all workers, or their exceptions."""
    answers: dict[str, Any] = {}
    with suppress(*CONNECTION_ERRORS):
        found = client.run(question, name, on_error="return")
        answers |= {f"the worker {k}": v for k, v in found.items()}
    try:
        with suppress(*CONNECTION_ERRORS):
            answers["the scheduler"] = client.run_on_scheduler(question, name)
    except ImportError as error:
        answers["the scheduler"] = error
    return answers


CONNECTION_ERRORS = (OSError, TimeoutError)  # connections of Dask end with them


def _connect(dask: Any, address: str) -> Any:
    """A client of the scheduler at an address; InputError where none answers.

    The client connects in a thread: a server that accepts the connection and stays silent would block it forever.
    """
    found: list[Any] = []

    def connect() -> None:
        try:
            found.append(dask.Client(address, timeout=ANSWER, set_as_default=False))
        except Exception as error:  # any kind of server may answer
            found.append(error)

    thread = Thread(target=connect, daemon=True)
    thread.start()
    thread.join(3 * ANSWER)
    if found and not isinstance(found[0], Exception):
        return found[0]
    reason = _describe(found[0]) if found else "something that does not answer as one"
    raise InputError("--cluster", address, reason, "a Dask scheduler, as tcp://host:8786")


def _threads(client: Any) -> int:
    """Threads of all workers; 0 where none has come, or the scheduler is gone."""
    try:
        return sum(client.nthreads().values())
    except Exception:  # a lost scheduler raises many kinds of errors
        return 0


def block_of(address: str, future: Any) -> RunBlock:
    if future.status != "finished":
        error = future.exception() if future.status == "error" else None
        found = "the connection lost" if error is None else f"a worker that fails ({_describe(error)})"
        raise InputError("--cluster", address, found, RESUME_HINT)
    found = future.result()
    if isinstance(found, tuple) and len(found) == 4 and all(isinstance(part, str) for part in found):
        raise InputError(*found)
    block: RunBlock = found
    return block


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def simulate_at_worker(task: _PlanTask, first: int, count: int) -> RunBlock | tuple[str, str, str, str]:
    """Simulate a block on a worker: the block, or the arguments of an InputError, which does not pickle."""
    here = version()
    if here != task.version:
        return "--cluster", "a worker", f"malta {here}", f"malta {task.version}"
    try:
        plan = unpickle_plan(task)
        if plan.identity != task.identity:
            return "--cluster", "a worker", "another revision of malta or of the machine", "the same as here"
        return fly(plan, first, count, workers=1)
    except InputError as error:
        return error.where, error.field, error.found, error.expected


@lru_cache(maxsize=4)
def unpickle_plan(task: _PlanTask) -> Plan:
    """The plan of a task, unpickled once: results for its machines and its scenario are cached by the object's id."""
    if task.sources:
        load_sources(task.machine, task.sources)
    plan: Plan = pickle.loads(task.plan)
    return plan
