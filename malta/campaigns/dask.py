"""Blocks of a campaign on a Dask cluster. The only module that imports dask.distributed, which is an extra."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from threading import Thread
from typing import TYPE_CHECKING, Any

from malta.campaigns.block import Block, fly
from malta.errors import InputError
from malta.model.machines import load_sources, sources_of

if TYPE_CHECKING:
    from malta.campaigns.plan import Plan

ANSWER = 3.0  # s, within which a scheduler answers
WAIT = 30.0  # s without any worker, after which the campaign stops


@dataclass(frozen=True)
class _Task:
    """A plan on its way to a worker, which keeps the first copy that it is sent.

    A machine of the user's own goes along as the text of its modules: the worker has no file of it.
    """

    identity: str
    version: str  # of malta
    machine: str
    sources: Mapping[str, str] = field(compare=False)  # of the machine's modules, by their names
    plan: bytes = field(compare=False)  # pickled: it can be read once the machine is there


def blocks(address: str, plan: Plan, left: Mapping[int, int]) -> Iterator[tuple[int, Block]]:
    """Blocks as workers finish them; a block whose worker dies goes to another one.

    left : first run -> number of runs

    Raises InputError when dask.distributed is not installed, nothing answers at the address, no worker comes, or a
    worker cannot do it.
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
            yield from _collect(dask, client, address, plan, left)
        finally:
            client.close(timeout=2)


def _collect(
    dask: Any, client: Any, address: str, plan: Plan, left: Mapping[int, int]
) -> Iterator[tuple[int, Block]]:
    task = _task(plan, version("malta"))
    waiting = {client.submit(_at_worker, task, *part, pure=False): part[0] for part in left.items()}
    alone = 0.0  # s
    while waiting:
        try:
            with client.as_current():
                done = dask.wait(list(waiting), timeout=1.0, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            alone = 0.0 if _workers(client) else alone + 1.0
            if alone >= WAIT:
                raise InputError("--cluster", address, "no workers", "a scheduler with some") from None
            continue
        except Exception as error:  # the scheduler is gone, and with it what was under way
            raise InputError(
                "--cluster", address, f"the connection lost ({type(error).__name__})", AGAIN
            ) from error
        for future in done:
            yield waiting.pop(future), _result(address, future)


def _task(plan: Plan, malta: str) -> _Task:
    name = plan.plant.name
    return _Task(plan.identity, malta, name, sources_of(name), pickle.dumps(plan))


AGAIN = "the same command once more: it goes on with what is left"


@contextmanager
def _silence_loggers() -> Iterator[None]:
    """Without the library's own messages: that a worker is lost is no news, other failures become one sentence."""
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


def _connect(dask: Any, address: str) -> Any:
    """A client of the scheduler. In a thread: what accepts the connection and says nothing would hold it forever."""
    found: list[Any] = []

    def connect() -> None:
        try:
            found.append(dask.Client(address, timeout=ANSWER, set_as_default=False))
        except Exception as error:  # what answers may be anything
            found.append(error)

    thread = Thread(target=connect, daemon=True)
    thread.start()
    thread.join(3 * ANSWER)
    if found and not isinstance(found[0], Exception):
        return found[0]
    reason = _describe(found[0]) if found else "something that does not answer as one"
    raise InputError("--cluster", address, reason, "a Dask scheduler, as tcp://host:8786")


def _workers(client: Any) -> int:
    try:
        return len(client.nthreads())
    except Exception:  # a scheduler that is lost says so in many ways
        return 0


def _result(address: str, future: Any) -> Block:
    if future.status != "finished":
        error = future.exception() if future.status == "error" else None
        found = "the connection lost" if error is None else f"a worker that fails ({_describe(error)})"
        raise InputError("--cluster", address, found, AGAIN)
    found = future.result()
    if isinstance(found, tuple) and len(found) == 4 and all(isinstance(part, str) for part in found):
        raise InputError(*found)
    block: Block = found
    return block


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _at_worker(task: _Task, first: int, count: int) -> Block | tuple[str, str, str, str]:
    """A block, or the parts of the error that refuses it: one that names its fields does not travel by itself."""
    here = version("malta")
    if here != task.version:
        return "--cluster", "a worker", f"malta {here}", f"malta {task.version}"
    try:
        return fly(_unpickle_plan(task), first, count, workers=1)
    except InputError as error:
        return error.where, error.field, error.found, error.expected


@lru_cache(maxsize=4)
def _unpickle_plan(task: _Task) -> Plan:
    """The plan, read once: what is computed for its machines and its scenario is kept by its place in memory."""
    if task.sources:
        load_sources(task.machine, task.sources)
    plan: Plan = pickle.loads(task.plan)
    return plan
