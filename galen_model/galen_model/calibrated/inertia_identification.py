# SPDX-License-Identifier: Apache-2.0
"""Inertia of all that hangs on the sensor, from a recording of free motion.

With s = g - a, Y the regressor of `galen_model.load.inertia`, x = (m, h, I) of tool and
adapter together and r the readings,

    r = Y(s, w, al) x + b - lag d/dt [Y(s, w, al) x] + noise,

linear in x and the offset b (the sensor's zero takes up the adapter's weight there), and, at the x
found before, in the lag of the wrench's stamps. The calibration file knows (m, h) far better than
motion does: it enters with its covariance. The same is fitted without the file, and the two (m, h)
are compared.

Residuals of neighbouring samples belong together (vibration, differentiated encoder steps), so the
covariance is taken from blocks of time, not from samples (Liang, Zeger, *Biometrika* 73, 1986):

    C = N^-1 (sum over blocks u u^T + P) N^-1 B / (B - p),   N = sum X^T W X + P,

u the sum of X^T W e over a block, P the file's information, B blocks, p parameters. Blocks that
disagree with the rest (the tool was touched) are left out.

`motion_record` makes a recording of joints and wrenches into the sensor's motion. Derivatives of
encoders are noisy, and noise in a regressor draws what is fitted by it towards zero; smoothing them
alone leaves a bias wherever the motion is fast. So joints and wrench go through the same zero-phase
low-pass before the joints are differentiated: what it takes away, it takes away on both sides of
the equation (Swevers, Verdonck, De Schutter, *IEEE Control Systems* 27(5), 2007, "parallel
filtering"). Products of slow and fast motion are filtered not quite alike, which matters only for
motion near the cut-off.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy  # its parts are loaded when they are used

from galen_model.arm.arm import Arm
from galen_model.arm.sensor_motion import sensor_motion
from galen_model.arrays import Array
from galen_model.calibrated.columns import moment_covariance
from galen_model.distributions import chi2_sf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.estimation.least_squares import Information
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.inertia import INERTIA_NAMES, InertiaEstimate, inertial_regressor
from galen_model.load.model import gravity_regressor
from galen_model.load.mounting import Mounting

CUTOFF_HZ = 10.0
"""The arm's own motion is below 5 Hz."""
_ORDER = 4
_SAMPLES_A_CUTOFF = 10.0
_EDGE_S = 0.3
_LARGEST_GAP_S = 0.05


@dataclass(frozen=True)
class MotionRecord:
    """The sensor's motion at each reading, all in ft_sensor: time_s (n,), the rest (n, 3), (n, 6).

    gravity, acceleration of the origin (m/s^2), angular velocity and acceleration, wrench.
    """

    time_s: Array
    gravity: Array
    acceleration_m_s2: Array
    velocity_rad_s: Array
    acceleration_rad_s2: Array
    wrench: Array

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.time_s)

    def take(self, rows: np.ndarray) -> MotionRecord:
        """Select some of the readings.

        Args:
            rows: mask (n,) or indices.

        Returns:
            Those readings.

        """
        return MotionRecord(*(getattr(self, name)[rows] for name in _FIELDS))


def motion_record(
    joint_stamp_ns: np.ndarray,
    joints: Array,
    wrench_stamp_ns: np.ndarray,
    wrenches: Array,
    mounting: Mounting | None = None,
    cutoff_hz: float = CUTOFF_HZ,
    *,
    arm: Arm,
) -> MotionRecord:
    """Make a recording of joints and wrenches into the sensor's motion.

    Readings come at ten times the cut-off; the ends of each stretch without a gap are left out, as
    filters have nothing to hold on to there.

    Args:
        joint_stamp_ns: (n,), increasing.
        joints: (n, d) of the arm, m and rad; rows that are not finite are left out.
        wrench_stamp_ns: (m,), increasing, of the same clock.
        wrenches: raw readings (m, 6), N and N.m; rows that are not finite are left out.
        mounting: of sensor and joints; None: as they should be.
        cutoff_hz: of the low-pass.
        arm: whose joints they are.

    Returns:
        The motion, and wrenches in ft_sensor.

    Raises:
        IdentificationError: joint states come too slowly, or joints and wrenches never together for
            long enough.

    """
    mounting = mounting or Mounting.of(arm)
    kept = np.isfinite(joints).all(axis=1)
    joint_stamp_ns, joints = joint_stamp_ns[kept], joints[kept]
    # Some drivers report endless joints within one turn.
    joints = arm.with_angles(np.unwrap(arm.angles(joints), axis=0), joints)
    kept = np.isfinite(wrenches).all(axis=1)
    wrench_stamp_ns, wrenches = wrench_stamp_ns[kept], wrenches[kept]
    start_ns = int(joint_stamp_ns[0]) if len(joint_stamp_ns) else 0
    joint_s = (joint_stamp_ns - start_ns) * 1e-9
    wrench_s = (wrench_stamp_ns - start_ns) * 1e-9
    parts = []
    for first_s, last_s in _stretches(joint_s, wrench_s):
        period_s = float(np.median(np.diff(joint_s)))
        if 1.0 / period_s < 4.0 * cutoff_hz:
            raise IdentificationError(
                f"joint_states come at {1.0 / period_s:.0f} Hz; {4.0 * cutoff_hz:.0f} Hz or more"
                " are needed to tell motion"
            )
        time_s = np.arange(first_s, last_s, period_s)
        sections = scipy.signal.butter(_ORDER, cutoff_hz, fs=1.0 / period_s, output="sos")
        smooth, felt = (
            scipy.signal.sosfiltfilt(sections, _at(time_s, own_s, values), axis=0)
            for own_s, values in ((joint_s, joints), (wrench_s, wrenches))
        )
        velocity = np.gradient(smooth, period_s, axis=0)
        acceleration = np.gradient(velocity, period_s, axis=0)
        step = max(1, round(1.0 / (_SAMPLES_A_CUTOFF * cutoff_hz * period_s)))
        edge = round(_EDGE_S / period_s)
        rows = slice(edge, len(time_s) - edge, step)
        angles = arm.angles(smooth[rows])
        true = arm.with_angles(angles + mounting.joint_zero_rad, smooth[rows])
        motion = sensor_motion(true, velocity[rows], acceleration[rows], arm)
        parts.append(
            MotionRecord(
                time_s[rows],
                mounting.gravity_in_sensor(angles, arm),
                motion.acceleration_m_s2,
                motion.velocity_rad_s,
                motion.acceleration_rad_s2,
                felt[rows] @ mounting.wrench_from_reading.T,
            )
        )
    if not parts:
        raise IdentificationError(
            f"joints and wrenches never come together for {4 * _EDGE_S:.1f} s without a gap"
        )
    return MotionRecord(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS)
    )


_FIELDS = (
    "time_s", "gravity", "acceleration_m_s2", "velocity_rad_s", "acceleration_rad_s2", "wrench",
)  # fmt: skip


def _at(time_s: Array, own_s: Array, values: Array) -> Array:
    return np.column_stack([np.interp(time_s, own_s, column) for column in values.T])


def _stretches(joint_s: Array, wrench_s: Array) -> list[tuple[float, float]]:
    """From where to where both come without a gap, s."""
    if len(joint_s) < 2 or len(wrench_s) < 2:
        return []
    first = max(joint_s[0], wrench_s[0])
    last = min(joint_s[-1], wrench_s[-1])
    borders = [(float(first), float(first)), (float(last), float(last))]
    for own_s in (joint_s, wrench_s):
        for row in np.flatnonzero(np.diff(own_s) > _LARGEST_GAP_S):
            borders.append((float(own_s[row]), float(own_s[row + 1])))
    borders.sort()
    found = []
    for (_, begin), (end, _) in pairwise(borders):
        if end - begin > 4 * _EDGE_S and first <= begin and end <= last:
            found.append((begin, end))
    return found


BLOCK_S = 0.5
FEWEST_BLOCKS = 24
MAX_RELATIVE_STD = 0.05
"""Of the inertia's size: along a direction that is known worse, the motion doesn't tell it."""

_LOAD, _INERTIA, _OFFSET, _LAG = slice(0, 4), slice(4, 10), slice(10, 16), 16
_PARAMETERS = 17
# Mean squares of a block over those of most blocks; three times as much in each reading.
_TOUCHED = 9.0
_ROUNDS = 3
OTHER_MASS = 0.2
"""By more than this part, the mass on the sensor is that of another tool."""
_MOST_TOUCHED = 1.0 / 3.0
_ITERATIONS = 3
_LONGEST_MEMORY = 50
_DEAD = 0.05


@dataclass(frozen=True)
class InertiaFit:
    """What a recording tells.

    moments (4,), moments_covariance: (m, h) without the file; file_distance: chi^2 of the
    difference to the file's, of 4 degrees of freedom, and disagrees whether noise does not make it.
    lag_s, lag_std_s: how late the wrench's stamps are.  offset (6,).
    blocks, touched: how many there are, and how many were left out.
    """

    inertia: InertiaEstimate
    moments: Array
    moments_covariance: Array
    file_distance: float
    lag_s: float
    lag_std_s: float
    offset: Array
    blocks: int
    touched: int

    @property
    def disagrees(self) -> bool:
        """Whether mass and centre in the recording are not the file's."""
        return _is_other(self.file_distance)


def _is_other(file_distance: float) -> bool:
    return bool(chi2_sf(file_distance, 4) < 1e-3)


def total_moments(tool: CalibrationFile) -> tuple[Array, Array]:
    """Sum up the moments of tool and adapter.

    Args:
        tool: with both loads.

    Returns:
        (m, h) (4,) and their covariance (4, 4), kg and kg.m.

    """
    total, covariance = np.zeros(4), np.zeros((4, 4))
    for part in (tool.load, tool.adapter):
        total += part.load.moments
        covariance += moment_covariance(part, np.zeros(4))
    return total, covariance


def identify_inertia(record: MotionRecord, moments: Array, covariance: Array) -> InertiaFit:
    """Identify the inertia of all that hangs on the sensor.

    Args:
        record: motion and wrenches.
        moments: (m, h) (4,) of tool and adapter from the file, kg and kg.m.
        covariance: of the moments, (4, 4).

    Returns:
        The inertia, and the comparison with the file's moments.

    Raises:
        NotExcitedError: naming the components that the motion doesn't identify.
        IdentificationError: the recording is too short, touched all over or of another tool, or
            holds no inertial forces.

    """
    block = np.floor((record.time_s - record.time_s[0]) / BLOCK_S).astype(int)
    count = len(np.unique(block))
    if count < FEWEST_BLOCKS:
        raise IdentificationError(
            f"{count * BLOCK_S:.1f} s of motion are too short: {FEWEST_BLOCKS * BLOCK_S:.0f} s are"
            " needed to tell the inertia and how well it is known"
        )
    # A file that claims to know (m, h) exactly must not make the fit singular.
    floor = np.diag([1e-8, 1e-10, 1e-10, 1e-10])
    prior: Array = np.asarray(np.linalg.inv(covariance + floor), dtype=np.float64)
    known = np.concatenate([moments, np.zeros(_PARAMETERS - 4)])
    fitted = _fit(record, block, prior, known)
    for _ in range(_ROUNDS):  # with what was left out gone, others may stand out
        kept = _untouched(fitted, block, record.acceleration_rad_s2)
        if kept.all():
            break
        record, block = record.take(kept), block[kept]
        touched = count - len(np.unique(block))
        if touched > _MOST_TOUCHED * count:
            raise IdentificationError(
                f"{touched} of {count} blocks of {BLOCK_S:g} s disagree with the rest: was the"
                " tool touched, is it another one, or are inertial forces not in the wrench?"
            )
        fitted = _fit(record, block, prior, known)
    touched = count - len(np.unique(block))
    free = _fit(record, block, np.zeros((4, 4)), known)
    difference = free.values[_LOAD] - moments
    distance = float(
        difference @ np.linalg.solve(free.covariance[_LOAD, _LOAD] + covariance + floor, difference)
    )
    # Where the motion does not identify the mass, it is not compared.
    identified = _inverse(free.information)[0, 0] < (OTHER_MASS / 3.0 * moments[0]) ** 2
    if identified and _is_other(distance) and abs(difference[0]) > OTHER_MASS * moments[0]:
        raise IdentificationError(
            f"the recording is of {1e3 * free.values[0]:.1f} g, the file of {1e3 * moments[0]:.1f}"
            " g on the sensor: another tool is on"
        )
    _check_there(record, fitted)
    _check_excited(fitted, moments)
    return InertiaFit(
        inertia=InertiaEstimate(fitted.values[_INERTIA], fitted.covariance[_INERTIA, _INERTIA]),
        moments=free.values[_LOAD],
        moments_covariance=free.covariance[_LOAD, _LOAD],
        file_distance=distance,
        lag_s=float(fitted.values[_LAG]),
        lag_std_s=float(np.sqrt(fitted.covariance[_LAG, _LAG])),
        offset=fitted.values[_OFFSET],
        blocks=count,
        touched=touched,
    )


@dataclass(frozen=True)
class _Fitted:
    values: Array
    covariance: Array
    information: Array
    residuals: Array
    sigma: Array


def _fit(record: MotionRecord, block: np.ndarray, prior: Array, known: Array) -> _Fitted:
    """Least squares with the channels' own noise, the lag linearised at the values before."""
    weight = inertial_regressor(
        record.gravity - record.acceleration_m_s2,
        record.velocity_rad_s,
        record.acceleration_rad_s2,
    )
    design = np.zeros((len(record), 6, _PARAMETERS))
    design[..., :10] = weight
    design[..., _OFFSET] = np.eye(6)
    inside = np.zeros((_PARAMETERS, _PARAMETERS))
    inside[_LOAD, _LOAD] = prior
    # Without a lag at first; the wrench is then known well enough to be shifted in time.
    free = np.arange(_PARAMETERS) != _LAG
    values, sigma = known.copy(), np.ones(6)
    sigma[3:] = 0.02
    edges = np.flatnonzero(np.diff(block)) + 1
    for step in range(_ITERATIONS + 1):
        if step:
            shape = np.gradient(weight @ values[:10], record.time_s, axis=0)
            # Blocks that were left out leave gaps in time, over which there is no derivative.
            design[..., _LAG] = np.where(_joined(record.time_s)[:, None], -shape, 0.0)
            free[_LAG] = bool(np.any(design[..., _LAG]))
        sums = _sums(design, record.wrench, edges)
        whole = _weighted(sums, sigma).total()
        information = whole.matrix + inside
        inverse = np.zeros((_PARAMETERS, _PARAMETERS))
        inverse[np.ix_(free, free)] = _inverse(information[np.ix_(free, free)])
        values = inverse @ (whole.right + inside @ known)
        residuals = record.wrench - design @ values
        sigma = _noise(residuals)
    blocks = _weighted(sums, sigma)
    information = blocks.total().matrix + inside
    inverse[np.ix_(free, free)] = _inverse(information[np.ix_(free, free)])
    scores = blocks.right - blocks.matrix @ values
    count = len(scores)
    middle = scores.T @ scores * count / max(count - _PARAMETERS, 1) + inside
    return _Fitted(values, inverse @ middle @ inverse, information, residuals, sigma)


def _sums(design: Array, wrench: Array, edges: np.ndarray) -> Information:
    """Sum up each channel's rows of each block, which begin at 0 and edges: (6, blocks)."""
    channels = [
        Information.of_blocks(
            zip(np.split(design[:, k], edges), np.split(wrench[:, k], edges), strict=True)
        )
        for k in range(6)
    ]
    return Information(*map(np.stack, zip(*channels, strict=True)))


def _weighted(sums: Information, sigma: Array) -> Information:
    """Return the channels' sums (6, blocks) together, by their noise (6,): (blocks,)."""
    return Information(*(np.tensordot(sigma**-2.0, part, axes=1) for part in sums))


def _noise(residuals: Array) -> Array:
    """Noise (6,) of each channel that so many independent readings would have to have.

    Filtered readings are not independent: n of them tell as much as n / k, k = 1 + 2 sum of the
    autocorrelation up to where it has died out.
    """
    spread = np.mean(residuals**2, axis=0) + 1e-24
    times = np.ones(6)
    alive = np.ones(6, dtype=bool)
    for lag in range(1, min(len(residuals) // 4, _LONGEST_MEMORY)):
        correlation = np.mean(residuals[lag:] * residuals[:-lag], axis=0) / spread
        alive &= correlation > _DEAD
        if not alive.any():
            break
        times += np.where(alive, 2.0 * correlation, 0.0)
    return np.asarray(np.sqrt(spread * times))


def _inverse(information: Array) -> Array:
    """Inverse of an information matrix whose parameters differ by orders of magnitude in size.

    What is not identifiable comes out enormous and not infinite, for `_check_excited` to name.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-6))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    values = np.maximum(values, 1e-13)
    return np.asarray((vectors / values) @ vectors.T * np.outer(scale, scale))


def _joined(time_s: Array) -> np.ndarray:
    """Which readings (n,) have their neighbours close by."""
    steps = np.diff(time_s)
    close = steps < 3.0 * np.median(steps)
    return np.concatenate([[True], close]) & np.concatenate([close, [True]])


def _untouched(fitted: _Fitted, block: np.ndarray, moving: Array) -> np.ndarray:
    """Which readings (n,) are in blocks that agree with the rest, in every channel.

    The rest is the half of the blocks in which the arm moved most: a real arm shakes when it moves.
    """
    _, index = np.unique(block, return_inverse=True)
    counts = np.bincount(index)[:, None]
    sums = np.zeros((len(counts), 6))
    np.add.at(sums, index, fitted.residuals**2)
    mean = sums / counts
    motion = np.bincount(index, np.sum(moving**2, axis=1)) / counts[:, 0]
    usual = np.median(mean[motion >= np.median(motion)], axis=0)
    agree: np.ndarray = np.all(mean <= _TOUCHED * usual, axis=1)
    return agree[index]


def _check_there(record: MotionRecord, fitted: _Fitted) -> None:
    """Raise IdentificationError where the readings are the weight's alone."""
    rows = np.zeros((len(record), 6, 10))
    rows[..., :4] = gravity_regressor(record.gravity)
    rows[..., 4:] = np.eye(6)
    scaled = (rows / fitted.sigma[None, :, None]).reshape(-1, 10)
    right = (record.wrench / fitted.sigma).reshape(-1)
    weight, *_ = np.linalg.lstsq(scaled, right, rcond=None)
    if np.sum((right - scaled @ weight) ** 2) < np.sum((fitted.residuals / fitted.sigma) ** 2):
        raise IdentificationError(
            "weight alone explains the readings better than weight and inertial forces: were they"
            " subtracted already?"
        )


def _check_excited(fitted: _Fitted, moments: Array) -> None:
    """Raise NotExcitedError, naming components, unless the motion tells the inertia."""
    size = max(
        float(np.abs(fitted.values[_INERTIA]).max()),
        # of a point mass at the centre of all
        float(moments[1:] @ moments[1:] / moments[0]),
    )
    # By the noise alone and by blocks: what was never moved can't be judged by its residuals.
    by_noise = _inverse(fitted.information)[_INERTIA, _INERTIA]
    covariance = (by_noise + fitted.covariance[_INERTIA, _INERTIA]) / 2.0
    variances, directions = np.linalg.eigh(covariance)
    bad = variances > (MAX_RELATIVE_STD * size) ** 2
    if not bad.any():
        return
    share = np.sum(directions[:, bad] ** 2, axis=1)
    missing = [name for name, part in zip(INERTIA_NAMES, share, strict=True) if part > 0.1]
    raise NotExcitedError(
        f"the motion does not tell the inertia's {', '.join(missing)}: turn all joints,"
        " each way and faster, each with the others at different places"
    )
