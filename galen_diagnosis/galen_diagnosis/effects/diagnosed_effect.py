# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis needs of an effect, in one record; what the effect does is the simulator's.

Inference, report, experiments and tables go over the records of `registry.py` and name no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
from galen_bags.arrays.tables import OrientationTable
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import Load
from galen_model.load.mounting import Mounting
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import contract_parameters
from scipy.sparse import csc_array

from galen_diagnosis.effects.candidates import Candidate, plain_form
from galen_diagnosis.effects.joint_terms import Columns, JointTerms
from galen_diagnosis.effects.jumps import Jump
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import DiagnosticRecording
from galen_diagnosis.observation.rows import ResidualRows

Sizes = float | tuple[float, ...]
KAPPA = {"exact": 0.015, "firm": 0.06, "loose": 0.2, "rough": 0.4}
"""Standard deviation of what a model may be off, as a part, by how well it is known."""


@dataclass
class FileParts:
    """What goes into a calibration file in the place of what was there.

    arm: whose file it becomes. mass_kg, com_m (3,), covariance (4, 4): of the tool. mounting,
    spread (n, n): its numbers and their covariance. estimated: which of them have changed.
    """

    arm: Arm
    mass_kg: float
    com_m: Array
    covariance: Array
    mounting: Mounting
    spread: Array
    estimated: list[str] = field(default_factory=list)

    def remount(self, name: str, at: Sequence[int], variances: Array, mounting: Mounting) -> None:
        """Take a mounting with another parameter.

        Args:
            name: What has changed, for `estimated`.
            at: Places of the parameter's k numbers among the mounting's.
            variances: Added to these numbers' variances, (k,).
            mounting: The new one, its covariance not yet changed.

        """
        self.mounting = mounting
        self.spread[at, at] += variances
        self.estimated.append(name)


@dataclass
class MujocoParts:
    """What a MuJoCo model is made of: the arm as it is.

    arm: with its geometry and stiffness. gravity_m_s2 (3,): in its base. tip_m (3,) and element
    (3, 3), the axes in which the sensor reads: in the sensor's frame. accelerating_kg: of tool and
    adapter, whose inertia about their own centres is own_kg_m2 (6,). By joint: zero (rad) and gain
    of the true value over the reported one, friction (N or N.m), attributes of a gap's joint.
    """

    arm: Arm
    gravity_m_s2: Array
    tool: Load
    tip_m: Array
    element: Array = field(default_factory=lambda: np.eye(3))
    accelerating_kg: float = 0.0
    own_kg_m2: Array = field(default_factory=lambda: np.zeros(6))
    zero: dict[str, float] = field(default_factory=dict)
    gain: dict[str, float] = field(default_factory=dict)
    friction: dict[str, float] = field(default_factory=dict)
    gap: dict[str, dict[str, Any]] = field(default_factory=dict)


def _plain(_: Observation, effect: Effect) -> Iterable[Candidate]:
    return [plain_form(effect)]


def no_forms(_: Observation, __: Any) -> Iterable[Candidate]:
    """Return that there are none.

    Args:
        _: Observation, not used.
        __: Effect or columns, not used.

    Returns:
        Nothing.

    """
    return ()


@dataclass(frozen=True)
class DiagnosedEffect:
    """What a diagnosis needs of one effect."""

    name: str
    """The contract's."""
    title: str
    """For people; `{joint}` stands for its joint."""
    sentence: str
    """What it does; `{NAME}` stands for a parameter with its interval."""
    remedy: str

    # --- how it shows in a recording ---------------------------------------------------------

    needs: Literal["", "tracker", "motion"] = ""
    """Without which nothing shows."""
    not_on_galen: tuple[str, ...] = ()
    """Joints of the Galen that the calibration of the probabilities has it not at."""
    healthy: bool = False
    """A healthy arm has some of it, which is fitted beside every cause: the forms are linear."""
    file_std: Callable[[CalibrationFile], Sizes] | None = None
    """Standard deviations of a healthy arm's numbers by the tool's file, where none are limited."""
    forms: Callable[[Observation, Any], Iterable[Candidate]] = _plain
    """Forms by the simulator's differences, of the effect that changes nothing yet."""
    columns: Callable[[Observation, Array], Iterable[Candidate]] = no_forms
    """Forms by the columns of the sensor's zero (N, 6)."""
    limits: Callable[[Observation, Array], Iterable[Candidate]] = no_forms
    """Limits of readings, by the same: forms that do something at once."""
    jump: Jump | None = None
    """A jump at a time that is not known."""
    most_forms: int = 1
    """How many of its forms are fitted on the simulator."""
    plausible: Callable[[Any, DiagnosticRecording], bool] = lambda effect, recording: True
    """Whether it can be so by what the recording's files say; a fit that can't is none."""
    general: bool = False
    """Linear in many numbers: not fitted where another single effect is far likelier."""
    parameters: Callable[[Observation, Any], dict[str, Any]] = lambda _, effect: (
        contract_parameters(effect)
    )
    """The contract's parameters of it in any of its forms."""

    # --- how far its model may be off --------------------------------------------------------

    known: Literal["exact", "firm", "loose", "rough"] = "exact"
    """How well its model is known."""
    by_second: bool = False
    """It may change from second to second."""
    remembers: bool = False
    """Of what was before: it lags within a second, and remembers of the way there."""
    before_bag: Callable[[Any, Observation, Array], csc_array] | None = None
    """Of one that remembers: columns, with unit priors, of what it keeps in a bag from before,
    which wasn't recorded; by those of the sensor's zero (N, 6)."""
    swings: bool = False
    """What it moves oscillates, which its model leaves out."""
    between_knots: Callable[[Any, ResidualRows, Array], csc_array] | None = None
    """Columns of what it does between a form's knots, by those of the sensor's zero."""

    # --- in another experiment ---------------------------------------------------------------

    later: Callable[[Any], Effect] = lambda effect: effect
    """What is known of it when something else is recorded; a jump happened once."""
    of_the_tool: bool = False
    """Without a tool it isn't there."""

    of_time: bool = False
    """It comes with time, and is no property of the arm."""

    # --- in tables ---------------------------------------------------------------------------

    hidden_in_table: Callable[[OrientationTable, bool], str] = lambda table, known_load: ""
    """Why a table of orientations doesn't show it; known_load: mass and centre aren't fitted."""
    in_joint_runs: Callable[[JointTerms], Sequence[Columns] | str] = lambda terms: ()
    """The ways in which it shows in a joint's runs, or why it can't."""

    # --- what corrects it --------------------------------------------------------------------

    in_description: Callable[[Any, Arm, Mapping[str, ElementTree.Element]], None] | None = None
    """Write it into a robot description's joints, by name; the arm has its true axes."""
    in_file: Callable[[Any, FileParts, Array], None] | None = None
    """Put it into a calibration file's parts, with the variances of its numbers."""
    advice: Callable[[Any, DiagnosticRecording], str | None] = lambda effect, recording: None
    """A sentence on what no such file holds."""

    # --- in other simulators -----------------------------------------------------------------

    in_mujoco: Callable[[Any, MujocoParts], None] | None = None
    """Put it into a MuJoCo model's parts; None where MuJoCo has no such thing."""
    mujoco: str = ""
    """What it is there or, where there is no such thing, what it does to what is read."""
    gazebo: str = ""
    """The same in Gazebo: elements of SDF."""

    @property
    def kappa(self) -> float:
        """Standard deviation of what its model may be off, as a part."""
        return KAPPA[self.known]

    def tolerances(self, recording: DiagnosticRecording, one: Candidate) -> Sizes | None:
        """Return the standard deviations of a healthy arm's numbers of one form.

        By the specification's limits or, where it has none, by the tool's file.

        Args:
            recording: Its specification and tool's file.
            one: A form of this effect.

        Returns:
            One for each free number, or one for all, in the numbers' units; None where a healthy
            arm has none.

        """
        if one.wider or not self.healthy:
            return None
        parts = tuple(one.base.limit_parts[k] for k in one.free)
        std = recording.specification.std(self.name, parts)
        if std is not None:
            return tuple(np.array(std) * one.limit_unit)
        return None if self.file_std is None else self.file_std(recording.tool)
