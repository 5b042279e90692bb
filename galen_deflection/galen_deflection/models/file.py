# SPDX-License-Identifier: Apache-2.0
"""Kinds of deflection models by name, and a model's file: written whole or not at all.

    {"schema_version": 1, "arm": {"name": "galen", "joints": ["delta_x", ..]},
     "kind": "joint_stiffness", "tip_m": [..3..],
     "parameters": [{"name": "1/k_roll", "unit": "rad/(N.m)", "value": 0.0005}, ...],
     "covariance": [[..]], "discrepancy": [[6x6]], "noise": [..6..], "fitted_range": {...},
     "fitted_on": {"samples": .., "segments": .., "positions": .., "sets": ..}, "unresolved": [..],
     "notes": [..],
     "sha256": "..."}

The other fields depend on the kind. A file without `arm` is of the Galen. The checksum is SHA-256
of all other fields as JSON without spaces and with sorted keys: it shows a file that was cut, mixed
or edited by hand.

PyTorch is imported by the training of a network only.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.files.atomic_file import write_whole
from galen_model.json_fields import (
    DEFLECTION_MODEL,
    FieldError,
    check_kind,
    check_version,
    get,
    mapping,
    parse_json,
    read_json,
    text,
    texts,
)

from galen_deflection.measurement.samples import DeflectionError, DeflectionSamples
from galen_deflection.models.axes import (
    COUPLED,
    INDEPENDENT,
    fit_coupled,
    fit_independent,
    read_axes,
)
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.network import LSTM, NetworkModel
from galen_deflection.models.network_training import fit_network
from galen_deflection.models.spring_fit import fit_hysteresis, fit_stiffness
from galen_deflection.models.spring_model import HYSTERESIS, STIFFNESS, SpringModel

SCHEMA_VERSION = 1
_MAX_FILE_BYTES = 10_000_000

DeflectionModel = SpringModel | NetworkModel
"""A fitted model: both predict samples, and give a stream for samples as they come."""


class ModelKind(NamedTuple):
    """A kind of model; fit raises DeflectionError; read, of a file's content, FieldError."""

    summary: str
    fit: Callable[[DeflectionSamples, FitSettings | None], DeflectionModel]
    read: Callable[[Mapping[str, Any], Arm], DeflectionModel]


KINDS: dict[str, ModelKind] = {
    STIFFNESS: ModelKind(
        "springs in the joints, carriages and rods", fit_stiffness, SpringModel.from_json
    ),
    HYSTERESIS: ModelKind(
        "the same with hysteresis in these springs, or of the platform as a whole",
        fit_hysteresis,
        SpringModel.from_json,
    ),
    LSTM: ModelKind(
        "the 2019 report's network: LSTM of 18 units, fully connected to the axes",
        fit_network,
        NetworkModel.from_json,
    ),
    INDEPENDENT: ModelKind(
        "baseline, the report's first model: each axis by the wrench's same axis",
        fit_independent,
        read_axes,
    ),
    COUPLED: ModelKind(
        "baseline, the report's second: each axis by all axes of the wrench",
        fit_coupled,
        read_axes,
    ),
}
"""Kinds in the order in which they are listed."""


def read_model(path: str | os.PathLike[str], arm: Arm) -> DeflectionModel:
    """Read and check a model's file.

    Args:
        path: file to read.
        arm: the arm that it is used on.

    Returns:
        The model.

    Raises:
        DeflectionError: the file can't be read, a field is wrong, or the model is of another arm,
            which has other joints; the message names the file and the field.

    """
    path = Path(path)
    try:
        content = read_json(path, _MAX_FILE_BYTES, "a model's file")
        return _model_of(content, arm)
    except OSError as error:
        raise DeflectionError(f"{path}: can't be read: {error.strerror}") from error
    except (FieldError, RecursionError) as error:
        raise DeflectionError(f"{path}: {error}") from error


def write_model(path: str | os.PathLike[str], model: DeflectionModel) -> None:
    """Write a model's file whole or not at all; the old one is kept as `.bak`.

    Args:
        path: file to write.
        model: the fitted model.

    Raises:
        DeflectionError: it can't be written, or not be read again; the message names the file, and
            the old one is untouched.

    """
    path = Path(path)
    try:
        arm = model.fitted_range.arm
        of = {"name": arm.name, "joints": list(arm.joint_names)}
        content = {"schema_version": SCHEMA_VERSION, "arm": of, **model.to_json()}
        content["sha256"] = _checksum(content)
        raw = json.dumps(content, indent=1, allow_nan=False) + "\n"
        _model_of(parse_json(raw), arm)  # what can't be read must not be written
    except (ValueError, FieldError) as error:
        raise DeflectionError(f"{path}: not written: {error}") from error
    try:
        write_whole(path, raw)
    except OSError as error:
        raise DeflectionError(f"{path}: can't be written: {error.strerror}") from error


def _model_of(content: Any, arm: Arm) -> DeflectionModel:
    whole = mapping(content, "the file")
    check_kind(whole, DEFLECTION_MODEL)
    check_version(whole, SCHEMA_VERSION)
    name = text(get(whole, "kind"), "kind")
    if name not in KINDS:
        raise FieldError(f'kind is "{name}"; this version knows {", ".join(KINDS)}')
    found = text(get(whole, "sha256"), "sha256")
    if found != _checksum(whole):
        raise FieldError("sha256 is not that of the content: it was changed or cut")
    _check_arm(whole, arm)
    return KINDS[name].read(whole, arm)


def _check_arm(whole: Mapping[str, Any], arm: Arm) -> None:
    """Raise FieldError for a model of an arm with other joints."""
    name, joints = GALEN.name, GALEN.joint_names
    if "arm" in whole:
        of = mapping(whole["arm"], "arm")
        name, joints = text(get(of, "name"), "arm.name"), texts(get(of, "joints"), "arm.joints")
    if joints != arm.joint_names:
        raise FieldError(
            f"is a model of the arm '{name}' ({', '.join(joints)}), not of '{arm.name}'"
            f" ({', '.join(arm.joint_names)}): give that arm's description, or train a model of"
            " this arm"
        )


def _checksum(content: Mapping[str, Any]) -> str:
    checked = {name: value for name, value in content.items() if name != "sha256"}
    try:
        canonical = json.dumps(checked, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError as error:  # Python reads NaN and 1e999, which no JSON holds
        raise FieldError(f"a number in it is not finite: {error}") from error
    return hashlib.sha256(canonical.encode()).hexdigest()
