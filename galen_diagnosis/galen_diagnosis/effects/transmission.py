# SPDX-License-Identifier: Apache-2.0
"""Effects between a motor and the tip: springs, friction, gaps, the joint's encoders and gear.

Of a joint's two angles and torque, the lag is the motor's angle less the link's. Beside the
encoders' zeros, with T the torque, q the motor's angle and v its velocity, it is

    compliance      c T, k = 1 / c
    backlash        what plays of the motion leave, q - play_r(q); gap 2 sum u r
    hysteresis      the part of plays of the torque beside a spring, play_r(T) - beta T; or a term
                    by the direction of motion (dry friction before the spring)
    encoder delay   v delay: the link's stamps are late against the motor's
    gear error      gain q

The last two names are not the contract's: an arm without encoders at both ends has neither.
`residual_fraction` is the loop's half width over half the range of the lag, since a joint's run has
no zero load after the largest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.transmission import TORQUE_PLAYS
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.hysteresis import (
    DeflectionCreep,
    DeflectionHysteresis,
    joint_columns,
)
from galen_sim_driver.effects.joints import CROSSINGS, SEAT, Backlash, JointCompliance
from galen_sim_driver.effects.registry import contract_parameters

from galen_diagnosis.effects.candidates import Candidate, floats, freed, plain_form
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, MujocoParts
from galen_diagnosis.effects.general_shapes import FrictionInJoints
from galen_diagnosis.effects.joint_terms import DELAY_S, Columns, JointTerms, in_lag
from galen_diagnosis.observation.observation import Observation

_FRICTIONS = {"tip": "Bouc and Wen, at the tip", "joints": "Dahl, in the joints"}
_CROSSED = {"stiction": "gap with stiction", "centred": "gap", "soft": "soft gap"}
_WIDTHS = {"stiction": 2.0, "centred": 0.5}
_SEVERAL = [0, 2, 4, 6]
_GEAR = 0.02
_SOFTEST = 1e-6
"""Where an interval's end would be less than rigid."""


def _compliances(_: Observation, effect: Effect) -> Iterator[Candidate]:
    for index, spring in enumerate(effect.fitted):
        name = spring.name.removeprefix("softness_")
        one = plain_form(effect, name, np.array([index]))
        # Of exactly 0 the effect keeps the spring nominal, and a fit can't leave it.
        yield replace(one, probe=np.array([0.05]))
    yield replace(plain_form(effect, "all"), probe=np.full(len(effect.fitted), 0.05), wider=True)


def _spring_of_runs(terms: JointTerms) -> list[Columns]:
    soft = terms.usual_softness

    def stiffness(w: Array) -> Array:
        return np.asarray(1.0 / (soft * max(w[0], _SOFTEST)))

    column = soft * terms.column["spring"][:, None]
    return [Columns(column, {"k": stiffness}, allowed=lambda w: bool(w[0] > 0.0))]


def _springs_in_mujoco(effect: Effect, parts: MujocoParts) -> None:
    parts.arm = effect.arm(parts.arm)


JOINT_COMPLIANCE = DiagnosedEffect(
    name=JointCompliance.name,
    title="stiffness of the arm",
    sentence="the arm's stiffness is not the nominal one: {stiffness}",
    remedy="check the screws of what is softer; train the deflection model anew",
    needs="tracker",
    healthy=True,
    forms=_compliances,
    known="firm",
    in_joint_runs=_spring_of_runs,
    in_mujoco=_springs_in_mujoco,
    mujoco="`kp` of the joint's `<position>`; a delta's carriages and rods are rigid there",
    gazebo="`<dynamics><spring_stiffness>` of a joint behind the driven one",
)


def _hysteresis(observation: Observation, _: Effect) -> Iterator[Candidate]:
    for form, knee, restarts in (
        ("tip", 0.08, True),
        ("tip", 0.3, True),
        ("tip", 1.0, True),
        ("tip", 0.3, False),
        ("joints", 0.2, True),
    ):
        effect = DeflectionHysteresis(form=form, knee=knee, restarts=restarts)
        free = np.arange(3) if form == "tip" else np.arange(1)
        kept = "" if restarts else " kept"
        one = plain_form(effect, f"{form} {knee:g}{kept}", free)
        probe = np.array([0.02, 0.05 * knee, 0.02])[free]
        typical = np.array([0.1, 0.5 * knee, 0.05])[free]
        yield replace(one, probe=probe, typical=typical, model=_FRICTIONS[form])
    recording = observation.recording
    none = FrictionInJoints.of(recording.arm, np.asarray(recording.tool.tip_m))
    if none.plays:
        yield _friction(observation, none)


def _friction(observation: Observation, none: FrictionInJoints) -> Candidate:
    """Return dry friction in each joint; which joints, and where fits begin, is linear."""
    count = len(none.weights)
    one = Candidate(
        *(DeflectionHysteresis.name, "in joints", none, np.arange(count), np.zeros(count)),
        *(np.full(count, 0.3), np.ones(count)),
        make=lambda values: replace(none, weights=floats(values)),
        wider=True,
    )
    unit = [observation.change([one.at(row)]) for row in np.eye(count)]

    def joined(values: Array) -> tuple[Candidate, Array]:
        begin = replace(none, weights=floats(values)).joined()
        count = len(begin.weights)
        start = np.concatenate([np.zeros(count), np.log(begin.thresholds)])
        fitted = Candidate(
            *(DeflectionHysteresis.name, "in joints", begin, np.arange(2 * count), start),
            typical=np.repeat([0.3, 0.5], count),
            probe=np.repeat([0.1, 0.05], count),
            model="dry friction in each joint",
            make=lambda own: begin.of_numbers(own[:count], np.exp(np.clip(own[count:], -9.0, 9.0))),
        )
        return fitted, np.concatenate([begin.weights, start[count:]])

    return replace(one, columns=np.stack(unit, axis=1), into=joined)


def _hysteresis_parameters(observation: Observation, effect: Effect) -> dict[str, Any]:
    if not isinstance(effect, FrictionInJoints):
        return contract_parameters(effect)
    scene = observation.views["push"].scene
    joints = scene.joints[np.searchsorted(scene.joint_s, scene.wrench_s[scene.touched][0])]
    tip_m = np.asarray(scene.tool.tip_m)
    return {"residual_fraction": effect.residual_fraction(joints, tip_m, scene.arm)}


def _loops_of_runs(terms: JointTerms) -> list[Columns]:
    column, scales, soft = terms.column, terms.scales, terms.usual_softness
    dry = scales.lag_half_range * column["direction"]
    ways = [in_lag(dry, "residual_fraction", lambda w: w[0], positive=True)]
    spring = column["spring"]
    for chosen in (*([k] for k in range(len(TORQUE_PLAYS))), _SEVERAL):
        plays = np.stack([column[TORQUE_PLAYS[k]] for k in chosen], axis=1)
        loops = soft * (plays - np.outer(spring, spring @ plays / (spring @ spring)))
        threshold = scales.torque_thresholds[chosen]
        rest = np.minimum(threshold, scales.torque_half_range - threshold)

        def fraction(w: Array, rest: Array = rest) -> Array:
            return np.asarray(soft * (w @ rest) / scales.lag_half_range)

        ways.append(in_lag(loops, "residual_fraction", fraction, positive=True))
    return ways


_PUSH_N = 10.0


def _friction_in_mujoco(effect: DeflectionHysteresis, parts: MujocoParts) -> None:
    """Friction F beside a spring under a push u: (u - F) / k under it, F / k after it."""
    arm = parts.arm
    loads = _PUSH_N * np.linalg.norm(joint_columns(arm.home, parts.tip_m, arm)[:3], axis=0)
    share = effect.residual_fraction / (1.0 + effect.residual_fraction)
    if effect.side > 0.0:
        for joint, load in zip(arm.joints, loads, strict=False):
            if np.isfinite(joint.stiffness):
                parts.friction[joint.name] = share * float(load)


DEFLECTION_HYSTERESIS = DiagnosedEffect(
    name=DeflectionHysteresis.name,
    title="hysteresis of the deflection",
    sentence="the deflection has hysteresis and keeps {residual_fraction} of itself"
    " when the load is gone",
    remedy="look for friction and loose screws; train a deflection model with it",
    needs="tracker",
    forms=_hysteresis,
    most_forms=2,
    parameters=_hysteresis_parameters,
    known="rough",
    remembers=True,
    in_joint_runs=_loops_of_runs,
    in_mujoco=_friction_in_mujoco,
    mujoco="`frictionloss` of the joints that give: it leaves residual_fraction after a push of"
    " 10 N; no such thing for a delta's rods, or where the tip runs ahead (side -1)",
    gazebo="`<dynamics><friction>`",
)


_CREEPS_S = (1.0, 3.0, 10.0)


def _creeps(_: Observation, effect: DeflectionCreep) -> Iterator[Candidate]:
    for tau_s in _CREEPS_S:
        base, label = replace(effect, tau_s=tau_s), f"{tau_s:g} s"
        typical, probe = np.array([0.1, 0.5 * tau_s]), np.array([0.01, 0.05 * tau_s])
        fitted = replace(plain_form(base, label), typical=typical, probe=probe)
        yield freed(plain_form(base, label, np.arange(1)), fitted)


DEFLECTION_CREEP = DiagnosedEffect(
    name=DeflectionCreep.name,
    title="creep of the deflection",
    sentence="under a constant load the deflection goes on by {fraction} of itself, over {tau_s}",
    remedy="look for plastic, rubber and loose screws that bear load; wait before measuring",
    needs="tracker",
    healthy=True,
    forms=_creeps,
    known="loose",
    remembers=True,
    mujoco="to the tip's elastic displacement e comes c with tau_s dc/dt = fraction e - c",
    gazebo="no such thing: the same formula",
)


def _backlashes(observation: Observation, effect: Backlash) -> Iterator[Candidate]:
    # With no gap the other numbers do nothing: they come in with the fit on the simulator.
    for joint, crossing in product(observation.recording.arm.turning_names, CROSSINGS):
        seat, width = (4.0, effect.width) if crossing == "soft" else (2.0, _WIDTHS[crossing])
        start = effect.start if crossing == "stiction" else 0.0
        base = replace(effect, joint=joint, seat=seat, width=width, start=start, crossing=crossing)
        count = 3 if crossing == "soft" else 4
        one = plain_form(base, f"{joint} {crossing}", np.arange(count))
        probe = np.array([1e-3, 0.05, 0.1, 0.02])[:count]
        yield replace(one, probe=probe, linear=1, model=_CROSSED[crossing])


def _gap_of_runs(terms: JointTerms) -> list[Columns]:
    """Return one gap, between two neighbouring thresholds, or several that close bit by bit."""
    lost, thresholds = terms.lost, terms.gaps
    pairs = [[k, k + 1] for k in range(len(thresholds) - 1)]
    return [
        in_lag(lost[:, chosen], "gap_rad", (2.0 * thresholds[chosen]).dot, positive=True)
        for chosen in (*pairs, list(range(0, len(thresholds), 4)))
    ]


def _gap_in_mujoco(effect: Backlash, parts: MujocoParts) -> None:
    if effect.changes_nothing:
        return
    half = 0.5 * effect.gap_rad
    moment = effect.seat * SEAT[parts.arm.units[effect.index]]
    holds = {"stiffness": moment / half} if effect.crossing == "soft" else {"frictionloss": moment}
    parts.gap[effect.joint] = {"range": np.array([-half, half]), **holds}


BACKLASH = DiagnosedEffect(
    name=Backlash.name,
    title="backlash",
    sentence="the {joint} joint has a backlash of {gap_rad}",
    remedy="look for play in gear, coupling and screws of the {joint} joint",
    forms=_backlashes,
    most_forms=3,
    known="rough",
    remembers=True,
    hidden_in_table=lambda table, _: "a table of orientations has no joints",
    in_joint_runs=_gap_of_runs,
    in_mujoco=_gap_in_mujoco,
    mujoco="a second joint of `range` ± gap_rad/2, with `frictionloss` or, of a soft gap,"
    " `stiffness`; its lag in motion without a load is no part of it",
    gazebo="a second joint of `<limit>` ± gap_rad/2 with `<dynamics><friction>`",
)

ENCODER_DELAY = DiagnosedEffect(
    name="encoder_delay",
    title="late encoder",
    sentence="the link's stamps are {delay_s} late against the motor's",
    remedy="correct the stamps of the link's encoder",
    in_joint_runs=lambda terms: [
        in_lag(DELAY_S * terms.column["delay"], "delay_s", lambda w: DELAY_S * w[0])
    ],
    mujoco="the link's angle stamped t is that of t - delay_s",
    gazebo="no such thing: the same shift",
)

GEAR_ERROR = DiagnosedEffect(
    name="gear_error",
    title="error of the gear",
    sentence="the gear's ratio is off by {gain}",
    remedy="correct the gear's ratio",
    in_joint_runs=lambda terms: [
        in_lag(_GEAR * terms.column["gear"], "gain", lambda w: _GEAR * w[0])
    ],
    mujoco="the link's angle is (1 - gain) times the motor's",
    gazebo="no such thing: the same formula",
)
