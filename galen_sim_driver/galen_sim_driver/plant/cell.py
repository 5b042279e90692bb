# SPDX-License-Identifier: Apache-2.0
"""The simulated cell: arm, sensor, tracker, hand. Steps without ROS, one sample a step.

The reading is the nominal measurement model,

    reading = W(theta; tool) + W(theta; adapter) - zero + applied wrench + noise,

with W = (m g, m p x g) of a load m at p under gravity g in ft_sensor, and the zero what the sensor
held when it was last zeroed; at the start W(home; adapter). What nominal lacks are the effects of
`effects/`, there only where the configuration asks for them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.load.model import ToolGeometry

from galen_sim_driver.plant.config import (
    VELOCITY_WINDOW_S,
    HandPush,
    PlantConfig,
    PlantError,
    acceleration_limits,
)
from galen_sim_driver.plant.effects import ArmNow, PlantEffects
from galen_sim_driver.plant.geometry import Quaternion, Vector, cross, rotate, to_quaternion
from galen_sim_driver.plant.hand import Admittance, Hand
from galen_sim_driver.plant.motion import (
    LimitedMotion,
    Reference,
    Trajectory,
    TrajectoryPoint,
    check_trajectory,
)
from galen_sim_driver.plant.sensors import ForceTorqueSensor, MarkerPose, Tracker, Zeroing


class Sample(NamedTuple):
    """Hold one step's outcome. Joint lists (n,) in m and rad, wrench (6,) in N and N.m."""

    stamp_ns: int
    true_joints: list[float]
    true_velocities: list[float]
    """Of the joints that the encoders measure."""
    positions: list[float]
    """As the encoders tell them."""
    velocities: list[float]
    """Differences of the encoders' positions over the velocity window."""
    wrench: list[float]
    """The reading, in ft_sensor."""
    tracker: tuple[MarkerPose | None, MarkerPose] | None
    """The tool's marker, None without a tool, and the base's; at the tracker's own rate."""


class Plant:
    """Hold the cell's state; `step()` goes on by one period."""

    def __init__(self, config: PlantConfig, rng: np.random.Generator) -> None:
        """Start at rest at `config.start`, no tool on, zeroed at home with the adapter on.

        The motion is that of the joints as the encoders see them; effects make true ones of them.

        Sensor and tracker draw from their own generators, spawned from `rng`, so that what one
        draws doesn't depend on the other's rate.
        """
        config.validate()
        self._config = config
        self._period_ns = config.period_ns
        self._period_s = config.period_ns * 1e-9
        working = [effect for effect in config.effects if not effect.changes_nothing]
        self._effects = PlantEffects(working, config.arm, config.adapter, config.arm.home.tolist())
        # How much later than the sample the stamps are.
        self.wrench_delay_ns = self._effects.wrench_delay_ns
        self.tracker_delay_ns = self._effects.tracker_delay_ns
        self._motion = LimitedMotion(config.arm, config.start, self._period_s)
        self._hold = list(config.start)
        self._quantum = config.quantum
        self._reference: Reference | None = None

        self.tool = ""
        """Name of the tool that is on, "" for none."""
        self._tip: list[float] = [0.0, 0.0, 0.0]
        # An acceleration at a stamp hangs on where the joints are a period later.
        self._ahead = self._effects.needs_motion
        self._ahead_ns = self._period_ns if self._ahead else 0

        sensor_rng, tracker_rng = rng.spawn(2)
        self._sensor = ForceTorqueSensor(config, self._effects.zero, sensor_rng)
        self.zero_angles: list[float] = config.arm.home_angles.tolist()
        """Of the revolute joints (rad), as the encoders see them, at the last zeroing."""
        self._zeroing: Zeroing | None = None
        self._tracker = Tracker(config, tracker_rng)
        self._tracker_count = 0
        self._place: tuple[tuple[float, ...], str] | None = None
        self._tip_pose: tuple[Vector, Quaternion]
        self._compliance: Array | None = None

        self._hand = Hand(config.hand)
        self.admittance = Admittance(config.admittance_timeout_s, config.arm)
        self.admittance_on = False
        self._lower, self._upper = config.arm.lower.tolist(), config.arm.upper.tolist()
        self._still = [0.0] * len(config.arm.joints)
        self._offset_step = [0.5 * a * self._period_s for a in acceleration_limits(config.arm)]
        # What admittance adds to the reference, and how fast that changes.
        self._offset = self._still
        self._offset_velocity = self._still

        self._count = 0
        self.now_ns = config.start_ns
        window = round(VELOCITY_WINDOW_S * config.rate_hz)
        start = self._encode(self._motion.positions)
        self._encoded: deque[list[float]] = deque([start] * window, maxlen=window)
        self._window_s = window * self._period_s

    # --- what the cell is doing -------------------------------------------------------------

    @property
    def moving(self) -> bool:
        """Whether a joint moves or a trajectory is not over."""
        return self._reference is not None or self._motion.moving

    @property
    def hand_active(self) -> bool:
        """Whether the hand is pushing, or has still to."""
        return self._hand.active

    # --- commands ---------------------------------------------------------------------------

    def command(self, trajectory: Trajectory) -> None:
        """Follow a trajectory from the present state, instead of any other.

        Args:
            trajectory: for some joints or all; without points it means: stop.

        Raises:
            PlantError: the trajectory is bad; nothing changes.

        """
        if not trajectory.points:
            self.stop()
            return
        motion_ns = self.now_ns + self._ahead_ns
        check_trajectory(trajectory, self._config.arm, motion_ns)
        motion = self._motion
        start = TrajectoryPoint(
            0.0,
            [q - offset for q, offset in zip(motion.positions, self._offset, strict=True)],
            [v - own for v, own in zip(motion.velocities, self._offset_velocity, strict=True)],
            # In admittance mode the acceleration is mostly that of the sensor's noise.
            self._still if self.admittance_on else motion.accelerations,
        )
        hold = self._stopping_reference()
        self._reference = Reference(trajectory, self._config.arm, motion_ns, start, hold)

    def stop(self) -> None:
        """Brake at the acceleration limits and stand."""
        self._hold = self._stopping_reference()
        self._reference = None

    def attach_tool(self, name: str) -> ToolGeometry | None:
        """Put a tool on, or remove it; a zeroing under way ends without effect.

        Args:
            name: of the configuration's tools; "" for none.

        Returns:
            The tool; None for none.

        Raises:
            PlantError: there is no such tool; the one that is on stays.

        """
        if name and name not in self._config.tools:
            known = ", ".join(sorted(self._config.tools)) or "none"
            raise PlantError(f"no tool '{name}' here; configured: {known}")
        tool = self._config.tools[name] if name else None
        self.tool = name
        self._set_load(tool)
        self._sensor.spoil_zeroing("the tool was changed")
        return tool

    def start_zeroing(self, window_s: float) -> Zeroing:
        """Zero the sensor at the mean of the next readings.

        Args:
            window_s: how long they are averaged, s of simulated time.

        Returns:
            The zeroing: ask its `done` and `error` after a step.

        Raises:
            PlantError: the arm moves or is in admittance mode, or a zeroing is under way.

        """
        if self.admittance_on:
            raise PlantError("the arm is in admittance mode")
        if self.moving:
            raise PlantError("the arm is moving")
        self._zeroing = self._sensor.start_zeroing(max(1, round(window_s / self._period_s)))
        return self._zeroing

    def set_admittance(self, on: bool) -> None:
        """Let the tip follow the wrench that `admittance` is fed, or stop it where it is.

        Args:
            on: whether it follows.

        """
        if on == self.admittance_on:
            return
        self.admittance_on = on
        self.admittance.forget()
        if on:
            self._sensor.spoil_zeroing("admittance mode was switched on")
        else:
            # What the hand did stays: the reference moves to where the arm is.
            self._offset, self._offset_velocity = (
                self._still,
                self._still,
            )
            self.stop()

    def start_hand(self) -> None:
        """Play the hand's script from its beginning."""
        self._hand.start(self.now_ns)

    def push(self, push: HandPush) -> None:
        """Push once, from now on.

        Args:
            push: its force and times, counted from now.

        Raises:
            PlantError: the hand is pushing already.
            ConfigError: the push makes no sense.

        """
        self._hand.push(push, self.now_ns)

    # --- time -------------------------------------------------------------------------------

    def step(self) -> Sample:
        """Go on by one period."""
        self._count += 1
        now_ns = self.now_ns = self._config.start_ns + self._count * self._period_ns
        motion = self._motion
        before, speeds = motion.positions.copy(), motion.velocities.copy()
        motion.step(self._targets(now_ns + self._ahead_ns))
        joints, velocities = motion.positions, motion.velocities
        if self._ahead:
            # The motion is a period ahead: its last two steps lie around the stamp.
            joints = before
            velocities = [0.5 * (a + b) for a, b in zip(speeds, velocities, strict=True)]
        if self._zeroing is not None and motion.moving:
            self._sensor.spoil_zeroing("the arm moved while the sensor was zeroed")

        effects = self._effects
        effects.at(self._count * self._period_s)
        now = effects.arm_now(joints)
        true, matrix, (gx, gy, gz), mass, (hx, hy, hz) = now
        wrench = [
            mass * gx,
            mass * gy,
            mass * gz,
            hy * gz - hz * gy,
            hz * gx - hx * gz,
            hx * gy - hy * gx,
        ]
        more = effects.more_wrench(now, velocities, motion.accelerations)
        if more is not None:
            wrench = [a + b for a, b in zip(wrench, more, strict=True)]
        touch = self._hand.wrench_at_tip(now_ns, matrix)
        if touch is not None:
            lever = cross(self._tip, touch[:3])
            for axis in range(3):
                wrench[axis] += touch[axis]
                wrench[axis + 3] += touch[axis + 3] + lever[axis]
        reading = self._sensor.read(effects.before_noise(wrench), effects.after_noise)
        if self._zeroing is not None and self._zeroing.done:
            if self._zeroing.error is None:
                self.zero_angles = [joints[index] for index in self._config.arm.turning]
            self._zeroing = None

        encoded = self._encode(joints)
        oldest, window_s = self._encoded[0], self._window_s
        reported_velocities = [(a - b) / window_s for a, b in zip(encoded, oldest, strict=True)]
        self._encoded.append(encoded)

        tracked = None
        due = int(self._count * self._config.tracker_rate_hz * self._period_s + 1e-9)
        if due > self._tracker_count:
            self._tracker_count = due
            tracked = self._look(now, touch)
        return Sample(
            now_ns,
            true.copy(),
            velocities.copy(),
            encoded,
            reported_velocities,
            reading,
            tracked,
        )

    # --- inside -----------------------------------------------------------------------------

    def _targets(self, now_ns: int) -> list[float]:
        """Where the joints should be at `now_ns`: the reference and what admittance adds."""
        reference = self._hold
        if self._reference is not None:
            reference = self._reference.sample(now_ns)
            if now_ns >= self._reference.end_ns:
                self._hold, self._reference = reference, None
        if not self.admittance_on:
            return reference
        joints = self._motion.positions
        velocities = self.admittance.joint_velocities(now_ns, joints, self._tip)
        # The hand's part changes its velocity by no more than half of what the joints can: a step
        # of it (noise alone makes some) on top of the reference's own acceleration would be more
        # than they follow, and a joint that has lost a moving reference catches up only late.
        velocities = [
            min(max(wanted, now - step), now + step)
            for wanted, now, step in zip(
                velocities or self._still,
                self._offset_velocity,
                self._offset_step,
                strict=True,
            )
        ]
        self._offset_velocity = velocities
        period_s = self._period_s
        targets = [
            # Held inside the limits, so that the offset doesn't wind up against them.
            min(max(origin + offset + velocity * period_s, low), high)
            for origin, offset, velocity, low, high in zip(
                reference, self._offset, velocities, self._lower, self._upper, strict=True
            )
        ]
        self._offset = [a - b for a, b in zip(targets, reference, strict=True)]
        return targets

    def _stopping_reference(self) -> list[float]:
        """Return the reference that brakes every joint now; admittance goes on adding its part."""
        stops = self._motion.stopping_positions(self._offset_velocity)
        return [q - offset for q, offset in zip(stops, self._offset, strict=True)]

    def _set_load(self, tool: ToolGeometry | None) -> None:
        self._effects.attach(tool)
        # Without a tool there is no tip; a hand then holds the sensor's own origin.
        self._tip = np.asarray(tool.tip_m, dtype=float).tolist() if tool else [0.0, 0.0, 0.0]

    def _encode(self, joints: Sequence[float]) -> list[float]:
        return [
            round(value / step) * step for value, step in zip(joints, self._quantum, strict=True)
        ]

    def _look(
        self, now: ArmNow, touch: Sequence[float] | None
    ) -> tuple[MarkerPose | None, MarkerPose]:
        effects = self._effects
        if not self.tool:
            return self._tracker.sample(None, None, effects.seen, effects.base_shift())
        place = (tuple(now.joints), self.tool)
        if place != self._place:  # the arm stands most of the time
            self._place, self._compliance = place, None
            self._tip_pose = (effects.position(now, self._tip), to_quaternion(now.matrix))
        deflection = None
        at_tip = [0.0] * 6
        if touch is not None:
            at_tip = [*rotate(now.matrix, touch[:3]), *rotate(now.matrix, touch[3:])]
            if self._compliance is None:
                self._compliance = effects.arm.tip_compliance(now.joints, self._tip)
            deflection = (self._compliance @ at_tip).tolist()
        more = effects.more_deflection(now, at_tip, deflection or [0.0] * 6)
        if more is not None:
            deflection = [a + b for a, b in zip(deflection or [0.0] * 6, more, strict=True)]
        return self._tracker.sample(self._tip_pose, deflection, effects.seen, effects.base_shift())
