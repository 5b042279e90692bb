# SPDX-License-Identifier: Apache-2.0
"""Effects of the sensor.

What is added to a reading, b(t), changes the rows by the sensor's zero's columns O_k times b_k(t)
(where the tool is pushed, the tip's too: the excess of the reading wasn't applied). So crosstalk,
squares, lags, drift and steps need no simulation of their own,

    crosstalk: O_to f_from(t),    drift: O_k phi(t),    step: O_k [t >= t_0].

A clipped axis shows as a pile of readings at its limit, of one size to the last bit where the noise
is clipped as well. What it should have read is predicted where the tool isn't touched. During a
push the load beyond the limit is not in the reading but in the deflection: an unknown input, which
each clipped push has in the form

    a_1 sin(pi u) + a_2 sin(3 pi u),   u from 0 to 1 over the time at the limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import permutations, product
from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.rotation import matrix_to_rotvec, rotvec_to_matrix
from galen_sim_driver.effects import sensor as simulated
from galen_sim_driver.effects.effect import Effect, Instants
from galen_sim_driver.effects.registry import contract_parameters
from galen_sim_driver.replay import GAP_S, Between, Replay
from scipy.sparse import csc_array, hstack

from galen_diagnosis.effects.candidates import Candidate, freed, linear_form, plain_form
from galen_diagnosis.effects.diagnosed_effect import (
    DiagnosedEffect,
    FileParts,
    MujocoParts,
    no_forms,
)
from galen_diagnosis.effects.general_shapes import SoftSaturation
from galen_diagnosis.effects.joint_terms import DELAY_S, Columns, JointTerms, in_lag
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import BAGS


def _turned_further(
    effect: simulated.SensorMountRotation, file: FileParts, variances: Array
) -> None:
    before = rotvec_to_matrix(file.mounting.sensor_rotvec_rad)
    turn = matrix_to_rotvec(before @ rotvec_to_matrix(effect.rotvec_rad))
    mounting = replace(file.mounting, sensor_rotvec_rad=turn)
    file.remount("sensor_rotation", range(3), variances, mounting)


def _turned_in_mujoco(effect: simulated.SensorMountRotation, parts: MujocoParts) -> None:
    parts.element = parts.element @ rotvec_to_matrix(effect.rotvec_rad)


SENSOR_MOUNT_ROTATION = DiagnosedEffect(
    name=simulated.SensorMountRotation.name,
    title="turned sensor",
    sentence="the sensor is turned in its mount, by {rotvec_rad}",
    remedy="correct the sensor's frame in the robot description",
    healthy=True,
    in_file=_turned_further,
    in_mujoco=_turned_in_mujoco,
    mujoco="the `quat` of the sensor's `<site>`",
    gazebo="the `<pose>` of the sensor, with `<force_torque><frame>` sensor",
)


def _gains_on_gains(effect: simulated.AxisGain, file: FileParts, variances: Array) -> None:
    gain = (1.0 + file.mounting.axis_gain) * (1.0 + np.array(effect.gain)) - 1.0
    file.remount(effect.name, range(3, 9), variances, replace(file.mounting, axis_gain=gain))


AXIS_GAIN = DiagnosedEffect(
    name=simulated.AxisGain.name,
    title="gains of the sensor's axes",
    sentence="the sensor's axes read too much, by {gain}",
    remedy="have the sensor calibrated, or divide its readings by the gains",
    healthy=True,
    in_file=_gains_on_gains,
    mujoco="reading_k becomes (1 + gain_k) reading_k",
    gazebo="no such thing: the same formula",
)


def crosstalks() -> list[tuple[str, str, simulated.Crosstalk]]:
    """Return all pairs of axes: from, to, effect."""
    return [
        (a, b, simulated.Crosstalk(from_axis=a, to_axis=b)) for a, b in permutations(WRENCH_AXES, 2)
    ]


def crosstalk_candidate(effect: simulated.Crosstalk) -> Candidate:
    """Return the form of one pair; coefficients between force and torque have a metre in them.

    Args:
        effect: The pair of axes.

    Returns:
        The form; its coefficient's unit is 1, m or 1/m.

    """
    metre = 0.1
    unit = 1.0
    if (effect.from_axis[0] == "f") != (effect.to_axis[0] == "f"):
        unit = metre if effect.to_axis[0] == "t" else 1.0 / metre
    size = 0.03 * unit
    label = f"{effect.from_axis} to {effect.to_axis}"
    one = plain_form(effect, label)
    one = replace(one, typical=np.array([size]), probe=np.array([0.1 * size]), limit_unit=unit)
    return replace(one, bonus=-np.log(len(crosstalks())))  # one of so many pairs


def crosstalk_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return all pairs of axes.

    Args:
        observation: What was measured.
        zero: Columns of the sensor's zero, (N, 6).

    Returns:
        30 forms.

    """
    reading = _at_rows(observation)
    found = []
    for from_axis, to_axis, effect in crosstalks():
        column = zero[:, WRENCH_AXES.index(to_axis)] * reading[:, WRENCH_AXES.index(from_axis)]
        found.append(replace(crosstalk_candidate(effect), columns=column[:, None]))
    return found


def _reading(_: Instants, reading: Array) -> Array:
    return reading


def _load(observation: Observation, name: str) -> Array:
    """Return a bag's reading (n, 6) at its wrenches' groups; untouched the predicted one."""
    scene = observation.views[name].scene
    return np.where(scene.touched[:, None], scene.reading, observation.nominal_reading(name))


def _at_rows(observation: Observation, of: Callable[[Instants, Array], Array] = _reading) -> Array:
    """Return at each row's time (N, 6) what `of` makes of a bag's reading (n, 6): itself.

    Where untouched it is the predicted one.
    """
    rows = observation.rows
    out = np.zeros((len(rows), 6))
    for name, view in observation.views.items():
        scene = view.scene
        here = rows.bag == BAGS.index(name)
        made = of(scene.instants(scene.wrench_s), _load(observation, name))
        out[here] = Between(rows.bag_s[here], scene.wrench_s).of(made)
    return out


CROSSTALK = DiagnosedEffect(
    name=simulated.Crosstalk.name,
    title="crosstalk in the sensor",
    sentence="the sensor reads {coefficient} of {from} in {to}",
    remedy="have the sensor's decoupling matrix calibrated",
    healthy=True,
    forms=no_forms,
    columns=crosstalk_candidates,
    most_forms=2,
    mujoco="coefficient times the reading of from_axis is added to that of to_axis",
    gazebo="no such thing: the same formula",
)


_BENT = (0.01,) * 3 + (0.2,) * 3
"""Usual nonlinearity, 1/N and 1/(N.m)."""
_LEAST_TARE = 0.02
"""Of the largest reading: the adapter's weight beyond which it counts."""


def nonlinear_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return each axis, its square with and without its sign.

    Of what it reads, and of its whole load: with the adapter's weight that it was zeroed at.

    Args:
        observation: What was measured.
        zero: Columns of the sensor's zero, (N, 6).

    Returns:
        12 to 24 forms; coefficients in 1/N and 1/(N.m).

    """
    reading = _at_rows(observation)
    weight = Replay(next(iter(observation.views.values())).scene).tare()[0]
    found = []
    for axis, name in enumerate(WRENCH_AXES):
        size = np.array([_BENT[axis]])
        heavy = abs(weight[axis]) > _LEAST_TARE * np.max(np.abs(reading[:, axis]), initial=0.0)
        tares = (0.0, float(weight[axis])) if heavy else (0.0,)
        for signed, tare in product((False, True), tares):
            effect = simulated.SensorNonlinearity(axis=name, signed=signed, tare=tare)
            square = replace(effect, coefficient=1.0).too_much(reading[:, axis])
            label = f"{name} {'odd' if signed else 'even'}{' of its load' if tare else ''}"
            columns = (zero[:, axis] * square)[:, None]
            one = replace(plain_form(effect, label), typical=size, probe=0.1 * size)
            # A healthy sensor's is of what it reads.
            found.append(replace(one, columns=columns, wider=tare != 0.0))
    return found


SENSOR_NONLINEARITY = DiagnosedEffect(
    name=simulated.SensorNonlinearity.name,
    title="nonlinear sensor",
    sentence="the sensor's {axis} reads {coefficient} of its square too much",
    remedy="have the sensor calibrated over its range",
    healthy=True,
    forms=no_forms,
    columns=nonlinear_candidates,
    known="firm",
    mujoco="reading becomes reading + coefficient ((reading + tare)² - tare²), each square"
    " times its root's sign where signed",
    gazebo="no such thing: the same formula",
)


_KNEES, _USUAL_KNEE = (0.05, 0.08, 0.13, 0.2, 0.32, 0.5), 0.2
_ONE_OF_MANY = -np.log(32.0)
"""Log evidence that a form of hysteresis has for being one of so many."""
_TOGETHER = ("all", "force", "torque")


def lagging_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return lags of forces, torques or both.

    They turn gradually or sharply. Over a pause of a bag what loads have left is gone, or stays.
    How far they go is a matter of a bag's largest load or, in the last form, of the sensor's: that
    one has what it may keep from before each bag among its columns, as it is as large.

    Args:
        observation: What was measured.
        zero: Columns of the sensor's zero, (N, 6).

    Returns:
        33 forms: linear in the fraction, the knee free in a fit.

    """
    found = []
    kinds = [(*kind, False) for kind in product((True, False), (False, True), _KNEES)]
    for restarts, sharp, knee, of_range in (*kinds, (True, False, _USUAL_KNEE, True)):
        unit = simulated.SensorHysteresis(
            1.0, knee=knee, restarts=restarts, sharp=sharp, of_range=of_range
        )
        lag = _at_rows(observation, unit.lag)
        for axes in _TOGETHER if knee == _USUAL_KNEE and not of_range else _TOGETHER[:1]:
            own = list(simulated.AXES[axes])
            columns = -np.sum(zero[:, own] * lag[:, own], axis=1, keepdims=True)
            if of_range:
                before = _before_bag(unit, observation, zero)
                columns = np.hstack([columns, before.toarray()])
            effect = replace(unit, fraction=0.0, axes=axes)
            label = f"{axes} {knee:g}{' sharp' * sharp}{'' if restarts else ' kept'}"
            label += " of its range" * of_range
            typical, probe = np.array([0.02, 0.5 * knee]), np.array([2e-3, 0.05 * knee])
            fitted = replace(
                plain_form(effect, label), typical=typical, probe=probe, bonus=_ONE_OF_MANY
            )
            one = linear_form(effect, label, columns, np.full(columns.shape[1], typical[0]))
            one = replace(one, bonus=_ONE_OF_MANY)
            # A healthy sensor's is that of forces and of torques, and turns neither soon nor late.
            usual = restarts and not sharp and knee == _USUAL_KNEE and axes != "all"
            found.append(freed(replace(one, wider=not usual), fitted, 1))
    return found


def _before_bag(
    effect: simulated.SensorHysteresis, observation: Observation, zero: Array
) -> csc_array:
    """Return what lags at the start of a bag's stretch may add to the rows while it lasts.

    A bag begins after moves that weren't recorded, and so does each stretch after a pause. The
    simulator's lags begin at rest there; others are as large as their ends at most, and go as the
    load changes (`SensorHysteresis.kept`).
    """
    rows, own = observation.rows, list(simulated.AXES[effect.axes])
    columns = []
    for name, view in observation.views.items():
        scene, here = view.scene, rows.bag == BAGS.index(name)
        load = _load(observation, name)
        starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(scene.wrench_s) > GAP_S)])
        for part in np.split(np.arange(len(load)), starts[1:]):
            if not len(part):
                continue
            during = here & (rows.bag_s >= scene.wrench_s[part[0]])
            during &= rows.bag_s <= scene.wrench_s[part[-1]]
            kept = effect.kept(load[part][:, own])
            there = Between(rows.bag_s[during], scene.wrench_s[part]).of(kept)
            columns += [
                _sparse(np.flatnonzero(during), -zero[during, axis] * lag, len(rows))
                for axis, lag in zip(own, there.T, strict=True)
            ]
    return hstack(columns, format="csc")


def _sparse(where: np.ndarray, values: Array, count: int) -> csc_array:
    return csc_array((values, (where, np.zeros(len(where), dtype=int))), shape=(count, 1))


SENSOR_HYSTERESIS = DiagnosedEffect(
    name=simulated.SensorHysteresis.name,
    title="hysteresis of the sensor",
    sentence="the sensor has hysteresis and keeps {fraction} of its reading when the load is gone",
    remedy="tighten the sensor's screws, or have it repaired",
    healthy=True,
    forms=no_forms,
    columns=lagging_candidates,
    most_forms=2,
    hidden_in_table=lambda table, _: "the way from reading to reading isn't in a table",
    known="rough",
    by_second=True,
    remembers=True,
    before_bag=_before_bag,
    mujoco="the reading lags the load, and keeps fraction of the largest when it is gone",
    gazebo="no such thing: the same lag",
)


def _late_torque(terms: JointTerms) -> list[Columns] | str:
    """Return c dT/dt delay, c of a plain fit: the torque's stamps are late."""
    plain = np.column_stack([terms.column[n] for n in ("offset", "gear", "delay", "spring")])
    give = float(np.linalg.lstsq(plain, terms.lag, rcond=None)[0][3])
    if not give > 0.0:
        return "the lag doesn't grow with the torque, so when it does is open"
    slope = DELAY_S * give * terms.torque_rate
    return [in_lag(slope, "delay_s", lambda w: DELAY_S * w[0])]


WRENCH_DELAY = DiagnosedEffect(
    name=simulated.WrenchDelay.name,
    title="late wrenches",
    sentence="the wrenches are {delay_s} late against the joints",
    remedy="take the delay off the stamps in the sensor's driver",
    needs="motion",
    healthy=True,
    known="firm",
    by_second=True,
    in_joint_runs=_late_torque,
    mujoco="the reading stamped t is that of t - delay_s",
    gazebo="no such thing: the same shift",
)

# Limits

_SATURATION = simulated.SensorSaturation.name
_PINNED, _NEXT = 6, 5
_PILE, _PILE_OVER = 25, 5.0
_LOWEST_PART = 0.4
_SAME = 1e-7
_NEAR_SIGMAS = 2.5
_LEAST_RUN_S = 0.08
_BEYOND = (2.0, 2.0, 2.0, 0.1, 0.1, 0.1)
_ORDERS = (1, 3, 5, 7)
_WORTH_EACH, _WORTH_MOST = 0.5, 40.0
_POWER, _FAR, _SHORT = 20.0, 1.5, np.array([0.02])


def saturation_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return limits that readings pile up at.

    Args:
        observation: What was measured.
        zero: Columns of the sensor's zero, (N, 6).

    Returns:
        A form for each axis with a pile; its numbers are the loads beyond, four a clipped push.

    """
    found = []
    for axis, name in enumerate(WRENCH_AXES):
        readings = np.concatenate(
            [bag.wrenches[:, axis] for bag in observation.recording.bags.values()]
        )
        noise = max(one[axis].std for one in observation.noise.values())
        for limit, bonus in _piles(np.abs(readings), noise):
            beyond = _beyond(observation, zero, axis, limit, noise)
            runs = beyond.shape[1] // len(_ORDERS)
            typical = np.tile(_BEYOND[axis] / np.array(_ORDERS), runs)
            effect = simulated.SensorSaturation(limit=limit, axis=name)
            one = linear_form(effect, f"{name} {limit:.4g}", beyond, typical)
            # Where readings pile up is known to the noise of one of them.
            known = {"limit": (limit - noise, limit + noise)}
            make = partial(_same, effect)
            one = replace(one, make=make, inputs=True, known=known, bonus=bonus)
            found.append(replace(one, model="hard limit"))
    return found


def bent_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return limits that axes bend towards, softly.

    Far below its limit L a reading falls short by x |x / L|^p / p.

    Args:
        observation: What was measured.
        zero: Columns of the sensor's zero, (N, 6).

    Returns:
        A form for each axis.

    """
    true = _at_rows(observation)
    found = []
    for axis, name in enumerate(WRENCH_AXES):
        largest = float(np.max(np.abs(true[:, axis])))
        short = -true[:, axis] * (np.abs(true[:, axis]) / largest) ** _POWER
        none = SoftSaturation(float(np.log(_FAR * largest)), float(np.log(_POWER)), name)
        label, columns = f"{name} softly", zero[:, [axis]] * short[:, None]
        fitted = plain_form(none, label, name=_SATURATION)
        fitted = replace(fitted, probe=np.array([0.01, 0.05]), model="soft limit")

        def begun(values: Array, fitted: Candidate = fitted) -> tuple[Candidate, Array]:
            share = min(max(_POWER * float(values[0]), 1e-3), 1e3)
            return fitted, fitted.start - np.array([np.log(_FAR) + np.log(share) / _POWER, 0.0])

        one = linear_form(none, label, columns, _SHORT, _SATURATION)
        found.append(replace(one, into=begun))
    return found


def _same(effect: Effect, _loads: Array) -> Effect:
    return effect


def _piles(sizes: Array, noise: float) -> list[tuple[float, float]]:
    """Limits (value, log evidence of the pile) of an axis from its readings' sizes (n,)."""
    top = float(sizes.max())
    if top <= 4.0 * noise:
        return []
    at_top = sizes >= top - _SAME * max(top, 1.0)
    pinned = int(np.sum(at_top))
    # Coarse steps repeat every value, a limit only its own.
    _, repeats = np.unique(sizes[~at_top], return_counts=True)
    usual = float(np.median(repeats[-_NEXT:])) if len(repeats) else 0.0
    if pinned >= _PINNED and pinned > 2.0 * usual:
        return [(top, min(_WORTH_EACH * pinned, _WORTH_MOST))]
    width = 2.0 * noise
    edges = np.arange(_LOWEST_PART * top, top + width, width)
    if len(edges) < 12:
        return []
    counts, _ = np.histogram(sizes, edges)
    # A limit has nothing above it, but for noise.
    last = len(counts) - 1
    for bin_ in range(last, max(last - 4, 6), -1):
        before = float(np.mean(counts[bin_ - 6 : bin_ - 2]))
        if counts[bin_] >= _PILE and counts[bin_] > _PILE_OVER * max(before, 1.0):
            inside = np.abs(sizes - edges[bin_]) < width
            return [(float(np.mean(sizes[inside])), 0.0)]
    return []


def _beyond(observation: Observation, zero: Array, axis: int, limit: float, noise: float) -> Array:
    """Columns (N, p): a few sines for each push that the axis clips, from a bump to a plateau."""
    columns = []
    for name, view in observation.views.items():
        if not view.tracks:
            continue
        bag = observation.recording.bags[name]
        # Columns of the zero tell what a reading's excess takes from the tip: loads add it.
        here = np.where(observation.rows.bag == BAGS.index(name), -zero[:, axis], 0.0)
        wrench_rows = observation.rows.channel < len(WRENCH_AXES)
        here[wrench_rows] = 0.0
        at_limit = np.abs(bag.wrenches[:, axis]) >= limit - _NEAR_SIGMAS * noise
        for start, end in _runs(bag.wrench_s, at_limit):
            sign = np.sign(np.interp(0.5 * (start + end), bag.wrench_s, bag.wrenches[:, axis]))
            u = (observation.rows.bag_s - start) / (end - start)
            inside = (u > 0.0) & (u < 1.0) & (here != 0.0)
            if inside.any():
                for order in _ORDERS:
                    shape = np.where(inside, np.sin(order * np.pi * u), 0.0)
                    columns.append(sign * here * shape)
    if not columns:
        return np.zeros((len(observation.rows), 0))
    return np.stack(columns, axis=1)


def _runs(at_s: Array, on: np.ndarray) -> list[tuple[float, float]]:
    """Return times from to in which `on` holds, short gaps of noise closed."""
    times = at_s[on]
    if not len(times):
        return []
    cuts = np.flatnonzero(np.diff(times) > _LEAST_RUN_S) + 1
    return [
        (float(run[0]), float(run[-1]))
        for run in np.split(times, cuts)
        if run[-1] - run[0] >= _LEAST_RUN_S
    ]


def _saturation_parameters(_: Observation, effect: Effect) -> dict[str, Any]:
    if isinstance(effect, SoftSaturation):
        return {"axis": effect.axis, "limit": effect.limit}
    return contract_parameters(effect)


SENSOR_SATURATION = DiagnosedEffect(
    name=_SATURATION,
    title="saturated sensor",
    sentence="the sensor's {axis} clips at {limit}",
    remedy="stay within the sensor's range, or take one of a larger range",
    forms=no_forms,
    columns=bent_candidates,
    limits=saturation_candidates,
    most_forms=2,
    known="loose",
    parameters=_saturation_parameters,
    mujoco="the axis' reading is clipped to ± limit; a sensor's `cutoff` clips three axes alike",
    gazebo="no such thing: the same formula",
)
