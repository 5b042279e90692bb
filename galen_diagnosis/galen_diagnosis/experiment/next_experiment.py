# SPDX-License-Identifier: Apache-2.0
"""The experiment that best separates the causes that are left, and how sure it would make.

Each of a list of experiments, from the least trouble to the most, is simulated with every
hypothesis and judged by `separation.py`; the one with the least trouble is taken of those that make
the answer as sure as the best does, but for a hundredth. Its poses or places are chosen for the
hypotheses; what some effects do in it differs from what they did in the recording (a tool that is
off has no mass error), and that is what most of them are for.

The Galen's poses and places are on a grid. Of another arm, whose surroundings are not known, they
are among those where the recording shows it standing.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from galen_common.command import writing
from galen_common.goal.parameters import MotionParameters
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError, NotExcitedError
from galen_model.files.atomic_file import write_whole
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identification import check_planned_poses
from galen_model.poses.design import PoseDesign, PoseDesignError
from galen_model.poses.plan import SweepRange, SweepTimes, order_poses

from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.experiment.separation import Alternative, choose_units, separate
from galen_diagnosis.experiment.trial import Trial, motion_trial, push_trial, still_trial

Program = Literal["calibration", "collection", "none"]

APART = 3.3
"""Pairs at a smaller distance can't be distinguished: 5 % of errors at Phi(-D/2)."""
_AS_GOOD = 0.01
_WORTH = 0.05
_MOST_ALTERNATIVES = 4

_OF_THE_TOOL = frozenset(name for name, record in RECORDS.items() if record.of_the_tool)
_POSES = 14
_AVERAGE_S = 1.0
_SETTLE_S = 0.4
"""As calibration_node's velocity_window_s and settle_s."""
_SWEEP = SweepRange(arm=GALEN, home=GALEN.home, lower=(-1.5, -1.0), upper=(1.5, 0.9))
_SPEEDS = (0.3, 1.0)
_MOTION_S = 20.0
_LEVELS_N = (3.0, 8.0)
_PLACES, _MOST_PLACES = 3, 15
# The platform moves, too: where it stands still, a turn about roll's axis is one of the tracker.
_PLATFORM_M = ((0.0, 0.0, 0.408), (0.07, -0.06, 0.45), (-0.07, 0.06, 0.36))
_ANGLES_RAD = ((0.0, 0.0), (0.9, -0.6), (-0.9, -0.6), (0.9, 0.6), (-0.9, 0.6))


@dataclass(frozen=True)
class Proposal:
    """An experiment that could be done: its kind, a sentence, what it would record.

    poses (n, joints): where to stand, m and rad, in this order; program: the node that runs it.
    """

    kind: str
    do: str
    poses: Array
    trials: tuple[Trial, ...]
    program: Program = "calibration"


@dataclass(frozen=True)
class Experiment:
    """What to do next.

    separates: the causes that it separates; not_separated: pairs that stay as they are. distance:
    the smallest D of the pairs that are separated. expected_probability: of the truth afterwards,
    before: now.
    """

    proposal: Proposal
    separates: tuple[str, ...]
    not_separated: tuple[tuple[str, str], ...]
    distance: float
    expected_probability: float
    before: float

    def to_json(self) -> dict[str, Any]:
        """Return `next_experiment` of diagnosis.json: the contract's two keys and more."""
        return {
            "separates": list(self.separates),
            "do": self.proposal.do,
            "kind": self.proposal.kind,
            "poses": len(self.proposal.poses),
            "distance": self.distance,
            "expected_probability": self.expected_probability,
            "probability_now": self.before,
            "not_separated": [list(pair) for pair in self.not_separated],
        }


def propose(
    alternatives: Sequence[Alternative], tool: CalibrationFile, stood: Array | None = None
) -> Experiment | None:
    """Return the next experiment for two or more hypotheses.

    Of more than four the likeliest four count.

    Args:
        alternatives: Hypotheses as fitted to the recording, with their probabilities.
        tool: The tool's file, with the arm.
        stood: Where the recording shows the arm standing, (n, joints), m and rad, n > 0; the Galen
            needs none.

    Returns:
        The experiment; None where none would help, or fewer than two hypotheses are left.

    """
    known = sorted(alternatives, key=lambda one: -one.probability)[:_MOST_ALTERNATIVES]
    known = [one for one in known if one.probability > 0.0]
    if len(known) < 2:
        return None
    left = [one.in_another_session() for one in known]
    probability = np.array([one.probability for one in left])
    before = float(np.sum((probability / probability.sum()) ** 2))
    judged = [(one, *separate(one.trials, left, tool)) for one in proposals(left, tool, stood)]
    best = max(expected for _, _, expected in judged)
    if best < before + _WORTH * (1.0 - before):
        return None
    proposal, distances, expected = next(one for one in judged if one[2] >= best - _AS_GOOD)
    distance = np.minimum(distances, distances.T)
    pairs = [(i, j) for i in range(len(known)) for j in range(i)]
    apart = [pair for pair in pairs if distance[pair] >= APART]
    # Where no pair comes that far, the farthest is what it is about.
    about = apart or [max(pairs, key=lambda pair: distance[pair])]
    return Experiment(
        proposal=proposal,
        separates=tuple(one.name for k, one in enumerate(known) if any(k in p for p in about)),
        not_separated=tuple(
            (known[j].name, known[i].name) for i, j in pairs if (i, j) not in about
        ),
        distance=float(min(distance[pair] for pair in about)),
        expected_probability=min(expected, 1.0),
        before=before,
    )


# The list


@dataclass(frozen=True)
class _Range:
    """Where the arm may go: angles (m, k), rad, about joints `home`, and places (p, joints)."""

    tool: CalibrationFile
    home: Array
    candidates: Array
    places: Array

    @classmethod
    def of(cls, tool: CalibrationFile, stood: Array | None) -> _Range:
        if tool.arm.joint_names == GALEN.joint_names:
            places = np.array([[*at, *angles] for at, angles in product(_PLATFORM_M, _ANGLES_RAD)])
            return cls(tool, GALEN.home, _SWEEP.candidates(), places)
        assert stood is not None
        candidates = np.unique(tool.arm.angles(stood).round(3), axis=0)
        return cls(tool, stood[0], candidates, stood[:: -(-len(stood) // _MOST_PLACES)])

    def joints(self, poses: Array) -> Array:
        """Joints (n, joints) at angles (n, k)."""
        return self.tool.arm.with_angles(poses, self.home)

    @property
    def times(self) -> SweepTimes:
        arm, motion = self.tool.arm, MotionParameters(arm=self.tool.arm)
        velocity, acceleration = map(arm.angles, (motion.max_velocity, motion.max_acceleration))
        return SweepTimes(arm.angles(self.home), velocity, acceleration, _SETTLE_S + _AVERAGE_S)

    def still(self, poses: Array, **options: Any) -> Trial:
        """Return the trial of a sweep of angles (n, k), in this order."""
        at_s = self.times.at_s(poses)
        return still_trial(poses, at_s, _AVERAGE_S, self.tool, at=self.home, **options)


def proposals(
    alternatives: Sequence[Alternative], tool: CalibrationFile, stood: Array | None = None
) -> Iterator[Proposal]:
    """Yield experiments, from the least trouble to the most.

    Args:
        alternatives: Hypotheses as they are in another session; poses are chosen for them.
        tool: The tool's file, with the arm.
        stood: Where the recording shows the arm standing, (n, joints), m and rad, n > 0; the Galen
            needs none.

    Yields:
        Still poses, the same in reversed order, with the tracker, with a second mass (of a tool
        with one), a motion at two speeds, pushes.

    """
    where = _Range.of(tool, stood)
    poses = _chosen_poses(alternatives, where, tracker=False)
    count, joints = len(poses), where.joints(poses)
    yield Proposal(
        "still poses",
        f"sweep these {count} still poses, {_AVERAGE_S:g} s each, without touching the tool",
        joints,
        (where.still(poses),),
    )
    both = np.concatenate([poses, poses[::-1]])
    yield Proposal(
        "reversed order",
        f"sweep these {count} still poses and then the same in reversed order, without zeroing the"
        " sensor between: what belongs to the pose comes back, what belongs to the time or the way"
        " doesn't",
        where.joints(both),
        (where.still(both),),
    )
    seen = _chosen_poses(alternatives, where, tracker=True)
    yield Proposal(
        "tracker at rest",
        f"sweep these {len(seen)} still poses with the tracker on and record both markers: the"
        " tip's place separates joints and frames from the sensor",
        where.joints(seen),
        (where.still(seen, tracker=True),),
    )
    if tool.load.mass_kg > 0.0:
        bare = where.still(poses, absent=_OF_THE_TOOL, tool_on=False)
        yield Proposal(
            "second mass",
            f"sweep these {count} still poses twice, with the adapter alone and with the tool on,"
            " as a calibration does: with two known masses a gain is not a mass",
            joints,
            (bare, where.still(poses)),
        )
    slow = _SPEEDS[0]
    yield Proposal(
        "two speeds",
        f"move all joints freely for {_MOTION_S:g} s at {slow:g} of the usual speed and for"
        f" {_MOTION_S:g} s at the full, without touching the tool: friction stays, a delay grows"
        " with the speed, inertia with its square",
        joints[:0],
        tuple(motion_trial(speed, _MOTION_S, tool, where.home) for speed in _SPEEDS),
        "none",
    )
    yield _pushes(alternatives, tool, where.places)


def _pushes(alternatives: Sequence[Alternative], tool: CalibrationFile, places: Array) -> Proposal:
    trial = push_trial(places, _LEVELS_N[-1:], tool)
    chosen = places[choose_units(trial, alternatives, tool, min(_PLACES, len(places)))]
    levels = " and ".join(f"{level:g}" for level in _LEVELS_N)
    names = tool.arm.joint_names
    there = "; ".join(
        ", ".join(f"{name} {value:g}" for name, value in zip(names, place, strict=True))
        for place in chosen
    )
    do = f"with the tracker on, push with {levels} N to both sides along each axis at {there}"
    return Proposal("pushes", do, chosen, (push_trial(chosen, _LEVELS_N, tool),), "collection")


def _chosen_poses(alternatives: Sequence[Alternative], where: _Range, *, tracker: bool) -> Array:
    """Return the poses that separate best, in a good order; a calibration can be made of them."""
    candidates, tool = where.candidates, where.tool
    trial = where.still(candidates, tracker=tracker)
    most = min(_POSES, len(candidates))
    poses = candidates[choose_units(trial, alternatives, tool, most)]
    if not _calibrates(poses, where):
        # Half of them for what shows the load: the behaviour rejects a sweep that doesn't.
        chosen = choose_units(trial, alternatives, tool, most // 2)
        with suppress(PoseDesignError):
            design = PoseDesign(candidates, arm=tool.arm).choose(most)
            chosen += [one for one in design if one not in chosen][: most - len(chosen)]
        poses = candidates[chosen]
    return order_poses(poses, where.times, tool.arm)


def _calibrates(poses: Array, where: _Range) -> bool:
    arm = where.tool.arm
    try:
        check_planned_poses(poses, zero_angles=arm.angles(where.home), arm=arm)
    except NotExcitedError:
        return False
    return True


# The file


_HEAD = """\
{do}
# It separates: {separates}.
#
#   ros2 run {node} --ros-args --params-file THIS_FILE{more}
#   ros2 run {command}
#
{remark}
"""
_SWEEP_REMARK = (
    "Record joint_states and wrench_raw{tracker} meanwhile. A calibration writes the tool's file:"
    " give it a directory of its own, so that the file in use stays."
)


def write_sweep(experiment: Experiment, path: Path, arm: Arm) -> None:
    """Write an experiment as parameters of the node that runs it, whole or not at all.

    Args:
        experiment: What to do.
        path: YAML file to write.
        arm: The Galen needs no description, of another arm the command names one.

    Raises:
        GalenError: No node runs the experiment, or the file can't be written.

    """
    proposal = experiment.proposal
    if proposal.program == "none":
        raise GalenError(
            f"{path}: not written: the next experiment ({proposal.kind}) is nothing that a node"
            f" runs; do it by hand: {proposal.do}"
        )
    parameters: dict[str, Any]
    is_galen = arm.joint_names == GALEN.joint_names
    if proposal.program == "calibration":
        tracker = ", tracker/tool_pose, tracker/base_pose" if "tracker" in proposal.kind else ""
        one_sweep = "" if proposal.kind == "second mass" else " --one-sweep"
        node, more = "galen_calibration_behavior calibration_node", " -p tools_dir:=DIR"
        command = f"galen_calibration_behavior calibrate TOOL --tip X Y Z{one_sweep}"
        remark = _SWEEP_REMARK.format(tracker=tracker)
        parameters = {"poses": "listed", "average_s": _AVERAGE_S}
        if is_galen:
            home = ("Xhome", "Yhome", "Zhome", "Rhome", "Thome")
            parameters |= dict(zip(home, GALEN.home.tolist(), strict=True))
        parameters["listed_poses_rad"] = _rounded(arm.angles(proposal.poses))
    else:
        node, more = "galen_deflection collection_node", ""
        command = "galen_deflection collect NAME --tool TOOL"
        remark = "It records what a diagnosis needs."
        parameters = {"positions": _rounded(proposal.poses), "forces_n": list(_LEVELS_N)}
    more += "" if is_galen else " -p urdf_file:=ARM.urdf"
    head = _HEAD.format(
        do=_comment(f"{proposal.do}."),
        separates=", ".join(experiment.separates),
        node=node,
        more=more,
        command=command,
        remark=_comment(remark),
    )
    body = yaml.safe_dump(
        {f"/**/{proposal.program}": {"ros__parameters": parameters}},
        sort_keys=False,
        default_flow_style=None,
        width=100,
    )
    with writing(path):
        write_whole(path, head + body)


def _comment(text: str) -> str:
    return textwrap.fill(text, 100, initial_indent="# ", subsequent_indent="# ")


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 5) for value in values.ravel()]
