"""The JSON schemas of the documents, made of their models, and of the files that malta reads."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from malta.cli.documents.campaigns import (
    CampaignOutput,
    DesignOutput,
    RareOutput,
    SimulateOutput,
    SobolOutput,
    StatusOutput,
    ToleranceOutput,
)
from malta.cli.documents.loops import CompareOutput, Part, ReportOutput, VerifyOutput
from malta.cli.documents.others import (
    CheckOutput,
    ClaimsOutput,
    CommissionOutput,
    ExciteOutput,
    ExportOutput,
    IdentifyOutput,
    LearnedStrokesOutput,
    LearnedV0Output,
    LearnOutput,
    LogOutput,
    MeasureOutput,
    MeasurePlanOutput,
    PilOutput,
    ReplayOutput,
    TuneOutput,
)
from malta.cli.documents.plots import PlotOutput
from malta.errors import InputError
from malta.schemas import SCHEMAS
from malta.schemas.files import DRAFT

MODELS: dict[str, type[Part]] = {
    "design-output": DesignOutput,
    "verify-output": VerifyOutput,
    "check-output": CheckOutput,
    "simulate-output": SimulateOutput,
    "campaign-output": CampaignOutput,
    "status-output": StatusOutput,
    "rare-output": RareOutput,
    "sobol-output": SobolOutput,
    "tolerance-output": ToleranceOutput,
    "tune-output": TuneOutput,
    "excite-output": ExciteOutput,
    "log-output": LogOutput,
    "identify-output": IdentifyOutput,
    "learn-output": LearnOutput,
    "learned-strokes-output": LearnedStrokesOutput,
    "learned-v0-output": LearnedV0Output,
    "replay-output": ReplayOutput,
    "measure-output": MeasureOutput,
    "measure-plan-output": MeasurePlanOutput,
    "commission-output": CommissionOutput,
    "plot-output": PlotOutput,
    "report-output": ReportOutput,
    "compare-output": CompareOutput,
    "export-output": ExportOutput,
    "pil-output": PilOutput,
    "claims-output": ClaimsOutput,
}


def output_schema(name: str) -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a document; `name` is a key of MODELS.

    >>> output_schema("export-output")["properties"]["to"]["enum"]
    ['c', 'fmu']
    """
    return {"$schema": DRAFT} | MODELS[name].model_json_schema(mode="serialization")


ALL_SCHEMAS: dict[str, Callable[[], dict[str, Any]]] = SCHEMAS | {
    name: partial(output_schema, name) for name in MODELS
}  # of files and of documents, by name


def schema_of(name: str) -> dict[str, Any]:
    """The JSON schema of a kind of file or of a document. Raises InputError for an unknown name.

    >>> schema_of("data")["required"]
    ['machine', 'parameters']
    """
    if name not in ALL_SCHEMAS:
        raise InputError("schema", "", repr(name), "one of " + ", ".join(ALL_SCHEMAS))
    return ALL_SCHEMAS[name]()
