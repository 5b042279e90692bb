# SPDX-License-Identifier: Apache-2.0
"""Effects of the load on the sensor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from galen_bags.arrays.tables import OrientationTable
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import Load
from galen_sim_driver.effects import load as simulated
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import contract_parameters

from galen_diagnosis.effects.candidates import Candidate, floats, plain_form
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, FileParts, MujocoParts
from galen_diagnosis.effects.general_shapes import ForceField, MassAtSensor
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import DiagnosticRecording

_MASS_KG, _COM_M = 0.1e-3, 0.1e-3
"""What a tool's file may be off at most and still be right, however unsure it says it is itself."""
_LEAST = 1e-6


def _is_fitted(_: OrientationTable, known_load: bool) -> str:
    return "" if known_load else "mass and centre are fitted (--tool)"


def _mass_added(effect: simulated.ToolMassError, file: FileParts, variances: Array) -> None:
    file.mass_kg += effect.delta_kg
    file.covariance[0, 0] += variances[0]


def _load_in_mujoco(effect: Effect, parts: MujocoParts) -> None:
    here = np.reshape(parts.tool.com_m, (1, 3))
    mass_kg, com_m = effect.tool_load(parts.tool.mass_kg, here, np.zeros((1, 3)))
    parts.tool = Load(mass_kg, com_m[0])


def _masses(observation: Observation, effect: simulated.ToolMassError) -> Iterator[Candidate]:
    """Yield a mass at the load's centre and, of a table, one at the sensor's, without a torque."""
    yield plain_form(effect)
    if observation.recording.readings is not None:
        yield replace(
            plain_form(MassAtSensor(), "at the sensor", name=effect.name),
            model="at the sensor's origin",
            wider=True,
        )


def _mass_parameters(
    _: Observation, effect: simulated.ToolMassError | MassAtSensor
) -> dict[str, Any]:
    return {"delta_kg": effect.delta_kg}


TOOL_MASS_ERROR = DiagnosedEffect(
    name=simulated.ToolMassError.name,
    title="tool's mass",
    sentence="the tool's true mass differs from its file's by {delta_kg}",
    remedy="calibrate the tool again",
    healthy=True,
    forms=_masses,
    most_forms=2,
    parameters=_mass_parameters,
    file_std=lambda tool: max(min(float(tool.load.mass_std_kg), _MASS_KG), _LEAST),
    of_the_tool=True,
    hidden_in_table=_is_fitted,
    in_file=_mass_added,
    in_mujoco=_load_in_mujoco,
    mujoco="the load's `<inertial mass>`",
    gazebo="`<inertial><mass>`",
)


def _com_std(tool: CalibrationFile) -> tuple[float, ...]:
    return tuple(max(float(min(std, _COM_M)), _LEAST) for std in tool.load.com_std_m)


def _centre_moved(effect: simulated.ToolComError, file: FileParts, variances: Array) -> None:
    file.com_m += effect.delta_m
    file.covariance[[1, 2, 3], [1, 2, 3]] += variances


TOOL_COM_ERROR = DiagnosedEffect(
    name=simulated.ToolComError.name,
    title="tool's centre of mass",
    sentence="the tool's centre of mass differs from its file's by {delta_m}",
    remedy="calibrate the tool again",
    healthy=True,
    file_std=_com_std,
    of_the_tool=True,
    hidden_in_table=_is_fitted,
    in_file=_centre_moved,
    in_mujoco=_load_in_mujoco,
    mujoco="the load's `<inertial pos>`",
    gazebo="`<inertial><pose>`",
)

LOOSE_TOOL = DiagnosedEffect(
    name=simulated.LooseTool.name,
    title="loose tool",
    sentence="the tool is loose and sags by {shift_m} in its mount",
    remedy="tighten the tool in its mount",
    healthy=True,
    known="rough",
    swings=True,
    of_the_tool=True,
    mujoco="the tool's centre moves by shift_m (d_x, d_y, 0), d the direction of gravity in the"
    " sensor's frame, and the load's by its mass' share of that: set body_ipos at each step",
    gazebo="no such thing: the same motion of the centre",
)


def _inertia_in_mujoco(effect: simulated.InertialLoad, parts: MujocoParts) -> None:
    parts.accelerating_kg = effect.mass_kg
    parts.own_kg_m2 = np.array(effect.own_inertia_kg_m2)


_GYRATION_M2, _LARGEST_M2 = 3e-3, 0.01
"""Own inertia over mass, usual and of what is held by a hand: squares of 55 and 100 mm."""


def _bodies(_: Observation, effect: simulated.InertialLoad) -> Iterator[Candidate]:
    """Yield points at the file's centres, and a body there whose own inertia is not known."""
    points = plain_form(effect, "points")
    yield points

    def body(values: Array) -> Effect:
        squares = np.zeros(6)  # in the linear picture the mass is all
        squares[: len(values) - 1] = values[1:]
        own = values[0] * np.clip(squares, -_LARGEST_M2, _LARGEST_M2)
        return replace(effect, mass_kg=float(values[0]), own_inertia_kg_m2=floats(own))

    typical = np.concatenate([points.typical, np.full(6, _GYRATION_M2)])
    start, probe = np.zeros(7), 0.05 * typical
    yield replace(
        points, label="body", free=np.arange(7), start=start, typical=typical, probe=probe,
        make=body, linear=1, wider=True,
    )  # fmt: skip


def _mass_is_the_files(effect: simulated.InertialLoad, recording: DiagnosticRecording) -> bool:
    """Whether a body has the mass of tool and adapter, to a factor of 2; of points it may be less.

    With an inertia of its own a body of any mass takes what something loose does in the tool.
    """
    whole = recording.tool.load.mass_kg + recording.tool.adapter.mass_kg
    if recording.inertial_forces or not any(effect.own_inertia_kg_m2):
        return True
    return 0.5 * whole < effect.mass_kg < 2.0 * whole


INERTIAL_LOAD = DiagnosedEffect(
    name=simulated.InertialLoad.name,
    title="inertial forces",
    sentence="inertial forces of {mass_kg} are missing in the model",
    remedy="compensate with inertial forces",
    needs="motion",
    forms=_bodies,
    plausible=_mass_is_the_files,
    most_forms=2,
    known="firm",
    advice=lambda _, recording: (
        None
        if recording.inertial_forces
        else "inertial forces: subtract them with gravcomp_node's parameter motion, and diagnose"
        " with --inertial-forces"
    ),
    in_mujoco=_inertia_in_mujoco,
    mujoco="the load's `fullinertia`, and how much of MuJoCo's inertial forces is read: `<numeric>`"
    " inertial_share",
    gazebo="`<inertial>`: its inertial forces are always read",
)

# Cable

_REACH_M = 0.7
"""How far from the tool a cable's other end is taken to be where its fit begins."""
_REACHES_M, _FARTHEST_M, _SMALL = (0.4, 1.0), 0.4, 1e-3
_ROWS_OF_A_START = 6000
_FEWEST_YAWS = 3


def _cables(observation: Observation, effect: simulated.CableDrag) -> Iterator[Candidate]:
    """Yield fields of forces, as of a hose or a hanging cable, and a taut cable.

    How likely a taut cable is linearly, and where its fit begins, follow from the field.
    """
    rotation, origin = observation.sensor_poses(2000)
    at = np.mean(origin + rotation @ np.asarray(effect.attachment_m), axis=0)
    none = ForceField(attachment_m=effect.attachment_m, at_m=floats(at))
    field_ = plain_form(none, "field", np.array([*range(9), *range(19, 22)]), effect.name)
    curved = plain_form(none, "curved field", name=effect.name)
    yield replace(field_, linear=9, model="elastic force, linear in the tool's place", wider=True)
    yield replace(
        curved, linear=19, model="elastic force, quadratic in the tool's place", wider=True
    )

    def taut(anchor: Array, label: str) -> Candidate:
        here = replace(effect, tension_n=0.0, anchor_m=floats(anchor), reference_m=floats(at))
        probe = np.array([0.05, *[0.02] * 3, *[0.005] * 3, 0.1, 1e-3])
        typical = np.array([0.3, *[0.4] * 3, *[0.06] * 3, 2.0, 0.01])
        return replace(plain_form(here, label), probe=probe, typical=typical, model="taut cable")

    def cable(values: Array) -> tuple[Candidate, Array]:
        tension = float(np.linalg.norm(values[:3]))
        fitted = taut(at + _REACH_M * values[:3] / max(tension, 1e-9), "taut")
        begin = fitted.start.copy()
        begin[0] = tension
        return fitted, begin

    yield replace(field_, label="taut", linear=9, into=cable)
    anchored = cache(lambda: _anchored(observation, effect, at))

    def from_anchor(_: Array) -> tuple[Candidate, Array]:
        begin = anchored()
        return taut(np.asarray(begin.anchor_m), "anchored"), begin.vector()

    yield replace(field_, label="anchored", linear=9, into=from_anchor)


def _anchored(
    observation: Observation, effect: simulated.CableDrag, at: Array
) -> simulated.CableDrag:
    """Return the taut cable that fits wrenches best of those to anchors all about the tool.

    Where the tool goes far a field is a poor start. At an anchor a cable of tension T, attached at
    r, that gets tighter by kappa a metre, pulls in T, T r and T kappa linearly. Some of the rows
    tell enough for a start.
    """
    rows = observation.rows
    of_wrench = np.flatnonzero(rows.channel < len(WRENCH_AXES))
    some = np.random.default_rng(0).permutation(of_wrench)[:_ROWS_OF_A_START]
    rotation, origin = rows.arm.sensor_pose(rows.joints[some])
    offsets = np.eye(6)[rows.channel[some]] / rows.scale[some, None]
    nominal = observation.nominal[some]

    def pulled(cable: simulated.CableDrag) -> Array:
        _, towards = simulated.cable_line(rotation, origin, cable.anchor_m, cable.attachment_m)
        force = cable.tension(rotation, origin)[:, None] * towards
        wrench = np.concatenate([force, np.cross(cable.attachment_m, force)], axis=1)
        return np.asarray(np.sum(offsets * wrench, axis=1))

    best: tuple[float, simulated.CableDrag] = (np.inf, effect)
    for reach_m, direction in product(_REACHES_M, _directions()):
        plain = replace(
            effect,
            tension_n=1.0,
            anchor_m=floats(at + reach_m * direction),
            attachment_m=(0.0,) * 3,
            stretch_per_m=0.0,
            bending_nm=0.0,
            reference_m=floats(at),
        )
        steps = [replace(plain, attachment_m=floats(_SMALL * one)) for one in np.eye(3)]
        steps.append(replace(plain, stretch_per_m=_SMALL))
        one = pulled(plain)
        slopes = [(pulled(step) - one) / _SMALL for step in steps]
        columns = np.column_stack([one, *slopes, offsets])
        found = np.linalg.solve(columns.T @ columns, columns.T @ nominal)
        left = nominal - columns @ found
        if found[0] > 0.0 and left @ left < best[0]:
            attachment = found[1:4] / found[0]
            farthest = max(float(np.linalg.norm(attachment)) / _FARTHEST_M, 1.0)
            begin = replace(
                plain,
                tension_n=float(found[0]),
                attachment_m=floats(attachment / farthest),
                stretch_per_m=float(np.clip(found[4] / found[0], 0.0, 20.0)),
            )
            best = float(left @ left), begin
    return best[1]


def _directions() -> Array:
    """Return the 26 directions (26, 3) to a cube's corners, edges and sides."""
    every = np.array([one for one in product((-1.0, 0.0, 1.0), repeat=3) if any(one)])
    return np.asarray(every / np.linalg.norm(every, axis=1, keepdims=True))


def _cable_parameters(
    observation: Observation, effect: simulated.CableDrag | ForceField
) -> dict[str, Any]:
    """Return the contract's parameters; the tension is the mean over the recording."""
    poses = observation.sensor_poses(100)
    if isinstance(effect, ForceField):
        tension = np.linalg.norm(effect.force(*poses), axis=1)
        return {"tension_N": float(np.mean(tension))}
    return {**contract_parameters(effect), "tension_N": float(np.mean(effect.tension(*poses)))}


def _level_pull_hidden(table: OrientationTable, _: bool) -> str:
    if table.rotation is None:
        return "the table has gravity alone, not the rotation"
    if _yaws(table.rotation) < _FEWEST_YAWS:
        return "the sensor hardly turns about gravity, a level pull is a bias"
    return ""


def _yaws(rotation: Array) -> float:
    """How much of a level force in the base is no constant in the sensor: rank beside gravity."""
    level = np.swapaxes(rotation, 1, 2)[:, :, :2].reshape(len(rotation), 6)
    about = level - level.mean(axis=0)
    sizes = np.linalg.svd(about, compute_uv=False) / np.sqrt(len(rotation))
    return float(np.sum(sizes > 0.1))


CABLE_DRAG = DiagnosedEffect(
    name=simulated.CableDrag.name,
    title="pulling cable",
    sentence="a cable pulls at the tool with {tension_N}",
    remedy="give the cable slack, or calibrate the tool with its cable",
    forms=_cables,
    most_forms=4,
    general=True,
    parameters=_cable_parameters,
    known="loose",
    of_the_tool=True,
    hidden_in_table=_level_pull_hidden,
    mujoco="a pull from attachment_m (sensor's frame) towards anchor_m (base's) of tension_n"
    " (1 + stretch_per_m (d - d_0)), or 0 where that is less, d the distance, d_0 that at"
    " reference_m; give it in xfrc_applied, since tendons do not reach a force sensor; bending_nm"
    " comes on top",
    gazebo="no such thing: the same pull by `ApplyLinkWrench`",
)
