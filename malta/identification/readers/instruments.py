"""Columns of files that need a package of their own: MDF4, TDMS, HDF5, Parquet, MCAP and bags of ROS 2."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.identification.readers.raw import (
    RawColumn,
    RawLog,
    heading_parts,
    module,
    numbers_of,
    raw_log,
    refuse_damage,
)
from malta.identification.readers.stored import MOST_IN_MEMORY

MAX_MESSAGE_ITEMS = 10_000  # numbers of a message


def mdf_log(path: Path) -> RawLog:
    """The channels of an MDF file, each with the times of its own group: nothing is resampled."""
    asammdf = module("asammdf", path, "asammdf")
    columns: list[RawColumn] = []
    places: list[tuple[int, int]] = []
    try:
        with asammdf.MDF(path) as file:
            for g, group in enumerate(file.groups):
                master = file.masters_db.get(g)
                own = [k for k, channel in enumerate(group.channels) if k != master and _is_number(channel)]
                if master is None or not own:
                    continue
                times = len(columns)
                columns.append(RawColumn(group.channels[master].name or "time", "s"))
                places.append((g, -1))
                for k in own:
                    channel = group.channels[k]
                    columns.append(RawColumn(channel.name, (channel.unit or "").strip("\0 "), times))
                    places.append((g, k))
    except Exception as error:  # asammdf raises many kinds
        raise refuse_damage(path, "file of MDF", error) from error

    def load(numbers: Sequence[int]) -> list[FloatArray]:
        try:
            with asammdf.MDF(path) as file:
                found = [
                    file.get_master(places[k][0]) if places[k][1] < 0
                    else file.get(group=places[k][0], index=places[k][1], samples_only=True)[0]
                    for k in numbers
                ]  # fmt: skip
                named = zip((columns[k].name for k in numbers), found, strict=True)
                return [numbers_of(np.array(one), name, path) for name, one in named]
        except Exception as error:
            raise refuse_damage(path, "file of MDF", error) from error

    return RawLog({}, columns, load, long=path.stat().st_size > MOST_IN_MEMORY)


def _is_number(channel: Any) -> bool:
    """Whether a channel of an MDF file has numbers: integers and reals of either order of bytes."""
    return int(getattr(channel, "data_type", 0)) <= 5 and int(getattr(channel, "channel_type", 0)) in (
        0,
        3,
        6,
    )


def tdms_log(path: Path) -> RawLog:
    """The channels of a TDMS file; each has times by its increment, where it says one."""
    nptdms = module("nptdms", path, "nptdms")
    columns: list[RawColumn] = []
    values: list[Any] = []
    head: dict[str, Any] = {}
    try:
        with nptdms.TdmsFile.open(path) as file:
            channels = [channel for group in file.groups() for channel in group.channels() if len(channel)]
            several = len({c.name for c in channels}) < len(channels)
            steps = {float(c.properties.get("wf_increment", 0.0) or 0.0) for c in channels} - {0.0}
            for channel in channels:
                if channel.dtype.kind not in "fiubM":
                    continue
                unit = str(channel.properties.get("unit_string", "") or "")
                name = f"{channel.group_name}/{channel.name}" if several else channel.name
                columns.append(RawColumn(name, unit))
                values.append(np.asarray(channel[:]))
    except Exception as error:  # npTDMS raises many kinds
        raise refuse_damage(path, "TDMS file", error) from error
    if len(steps) > 1:
        raise InputError(
            path, "wf_increment", f"channels of {len(steps)} sample times", "one, or choose by --columns"
        )
    if steps:
        head["sample_time"] = steps.pop()
    return raw_log(head, columns, values, path)


def parquet_log(path: Path) -> RawLog:
    """The columns of a Parquet file; `machine`, `period` and so on are metadata of its schema."""
    arrow, parquet = module("pyarrow", path, "pyarrow"), module("pyarrow.parquet", path, "pyarrow")
    try:
        schema = parquet.read_schema(path)
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise refuse_damage(path, "Parquet file of numbers", error) from error
    stored = {
        name.decode(errors="replace"): value.decode(errors="replace").split()
        for name, value in (schema.metadata or {}).items()
    }
    head: dict[str, Any] = {name: words[0] for name, words in stored.items() if words and name != "pandas"}
    head |= {"malta": head["malta log"]} if "malta log" in head else {}
    if "idle" in stored:
        head["idle"] = " ".join(stored["idle"])
    columns = [RawColumn(*heading_parts(name)) for name in schema.names]
    if not columns:
        raise InputError(path, "", "no columns", "t [s], x1 [m], ...")

    def load(numbers: Sequence[int]) -> list[FloatArray]:
        try:
            read = parquet.read_table(path, columns=[schema.names[k] for k in numbers], use_threads=False)
            return [
                _arrow_numbers(read.column(schema.names[k]), arrow, columns[k].name, path) for k in numbers
            ]
        except (arrow.ArrowException, OSError, ValueError) as error:
            raise refuse_damage(path, "Parquet file of numbers", error) from error

    return RawLog(head, columns, load, long=path.stat().st_size > MOST_IN_MEMORY)


def _arrow_numbers(column: Any, arrow: Any, name: str, path: Path) -> FloatArray:
    """A column of Arrow as doubles, NaN where it has none; instants in s."""
    if arrow.types.is_temporal(column.type):
        return numbers_of(column.to_numpy(), name, path)
    return np.asarray(column.cast(arrow.float64()).to_numpy(), dtype=float)


def mcap_log(path: Path) -> RawLog:
    """The messages of the largest channel of an MCAP file whose messages are JSON; log times are its times."""
    reader = module("mcap.reader", path, "mcap")
    rows: dict[str, list[dict[str, Any]]] = {}
    times: dict[str, list[int]] = {}
    other = ""
    try:
        with path.open("rb") as file:
            for _, channel, message in reader.make_reader(file).iter_messages():
                if channel.message_encoding != "json":
                    other = channel.message_encoding
                    continue
                rows.setdefault(channel.topic, []).append(_flat(json.loads(message.data)))
                times.setdefault(channel.topic, []).append(message.log_time)
    except Exception as error:  # mcap raises many kinds
        raise refuse_damage(path, "MCAP file", error) from error
    if not rows and other:
        found = f"messages in {other}"
        raise InputError(
            path, "", found, "messages in JSON; a bag of ROS 2 is read as its folder, by rosbags"
        )
    return _messages_log(rows, times, path)


def bag_log(path: Path) -> RawLog:
    """The messages of the largest topic of a bag of ROS 2, a folder; their times are those of the record."""
    anyreader = module("rosbags.highlevel", path, "rosbags").AnyReader
    rows: dict[str, list[dict[str, Any]]] = {}
    times: dict[str, list[int]] = {}
    try:
        store = module("rosbags.typesys", path, "rosbags")
        types = store.get_typestore(store.Stores.LATEST)
        with anyreader([path], default_typestore=types) as reader:
            for connection, stamp, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                rows.setdefault(connection.topic, []).append(_flat(message))
                times.setdefault(connection.topic, []).append(stamp)
    except Exception as error:  # rosbags raises many kinds
        raise refuse_damage(path, "bag of ROS 2", error) from error
    return _messages_log(rows, times, path)


def _flat(message: Any, name: str = "") -> dict[str, Any]:
    """The numbers of a message by name: of parts "part.name", of lists "name_1", "name_2", ..."""
    if isinstance(message, bool | int | float | np.number):
        return {name or "data": float(message)}
    if isinstance(message, np.ndarray | list | tuple):
        listed = np.asarray(message).ravel() if len(message) <= MAX_MESSAGE_ITEMS else np.zeros(0)
        numbers = listed if listed.dtype.kind in "fiub" else listed[:0]
        return {f"{name}_{k + 1}": float(v) for k, v in enumerate(numbers)}
    parts = message if isinstance(message, dict) else getattr(message, "__dict__", {})
    found: dict[str, Any] = {}
    for key, value in parts.items():
        if not key.startswith("__") and key != "layout":  # of an array of ROS
            found |= _flat(value, f"{name}.{key}" if name else key)
    return found


def _messages_log(rows: dict[str, list[dict[str, Any]]], times: dict[str, list[int]], path: Path) -> RawLog:
    """Columns of the messages of one topic: that with most numbers."""
    if not rows:
        raise InputError(path, "", "no messages", "messages with numbers")
    topic = max(rows, key=lambda name: len(rows[name]) * len(rows[name][0]))
    names = list(dict.fromkeys(name for row in rows[topic][:100] for name in row))
    stamps = np.array(times[topic], dtype=np.int64)
    columns = [RawColumn("log time", "s"), *(RawColumn(*heading_parts(name), times=0) for name in names)]
    values = [np.array([row.get(name, np.nan) for row in rows[topic]]) for name in names]
    t = (stamps - stamps[0]) / 1e9 if stamps[0] > 10**17 else stamps / 1e9
    return raw_log({"topic": re.sub(r"\s", "_", topic)}, columns, [t, *values], path)
