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
from galen_model.arm.galen import GRAVITY_M_S2, HOME
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arm.stiffness import tip_compliance
from galen_model.load.model import gravity_wrench
from galen_model.load.nominal_tools import ToolGeometry

from galen_sim_driver.plant.config import HandPush, PlantConfig, PlantError
from galen_sim_driver.plant.effects import ArmNow, PlantEffects
from galen_sim_driver.plant.geometry import (
    ArmGeometry,
    Matrix,
    cross,
    rotate,
    sensor_matrix,
    sensor_quaternion,
)
from galen_sim_driver.plant.hand import Admittance, Hand
from galen_sim_driver.plant.motion import (
    JointState,
    LimitedMotion,
    Reference,
    Trajectory,
    check_trajectory,
)
from galen_sim_driver.plant.sensors import ForceTorqueSensor, Tracker, TrackerSample, Zeroing

_G = -float(GRAVITY_M_S2[2])


class Sample(NamedTuple):
    """One step's outcome. Joint lists (5,) in m and rad, wrench (6,) in N and N.m."""

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
    tracker: TrackerSample | None
    """At the tracker's own rate, else None."""


class Plant:
    """The cell's state. `step()` goes on by one period; everything else changes what it does."""

    def __init__(self, config: PlantConfig, rng: np.random.Generator) -> None:
        """Start at rest at `config.start_joints`, no tool on, zeroed at home with the adapter on.

        The motion is that of the joints as the encoders see them; effects make true ones of them.

        Sensor and tracker draw from their own generators, spawned from `rng`, so that what one
        draws doesn't depend on the other's rate.
        """
        config.validate()
        self._config = config
        self._period_ns = config.period_ns
        self._period_s = config.period_ns * 1e-9
        self._geometry = ArmGeometry(config.arm)
        self._effects = _effects_at_work(config)
        self._arm = config.arm if self._effects is None else self._effects.arm
        self._motion = LimitedMotion(config.motion, config.start_joints, self._period_s)
        self._hold = list(config.start_joints)
        self._reference: Reference | None = None

        self._tool = ""
        self._tip: list[float] = [0.0, 0.0, 0.0]
        self._mass = 0.0
        self._moment: list[float] = []
        self._set_load(None)
        # An acceleration at a stamp hangs on where the joints are a period later.
        self._ahead = self._effects is not None and self._effects.needs_motion
        self._ahead_ns = self._period_ns if self._ahead else 0

        sensor_rng, tracker_rng = rng.spawn(2)
        if self._effects is None:
            zero = gravity_wrench(gravity_in_sensor(HOME[3], HOME[4]), config.adapter).tolist()
        else:
            zero = self._effects.zero
        self._sensor = ForceTorqueSensor(config.sensor, zero, sensor_rng)
        self._zero_pose = (float(HOME[3]), float(HOME[4]))
        self._zeroing: Zeroing | None = None
        self._tracker = Tracker(config.tracker, tracker_rng)
        self._tracker_count = 0
        self._compliance_of: tuple[tuple[float, ...], str] | None = None
        self._compliance = np.zeros((6, 6))

        self._hand = Hand(config.hand)
        self._admittance = Admittance(config.admittance, self._geometry, config.motion.velocity)
        self._admittance_on = False
        self._offset_step = [0.5 * a * self._period_s for a in config.motion.acceleration]
        # What admittance adds to the reference, and how fast that changes.
        self._offset = [0.0] * 5
        self._offset_velocity = [0.0] * 5
        self._lower = config.motion.limits.lower.tolist()
        self._upper = config.motion.limits.upper.tolist()

        self._count = 0
        self.now_ns = config.start_ns
        window = round(config.velocity_window_s * config.rate_hz)
        start = self._encode(self._motion.positions)
        self._encoded: deque[list[float]] = deque([start] * window, maxlen=window)
        self._window_s = window * self._period_s

    # --- what the cell is doing -------------------------------------------------------------

    @property
    def tool(self) -> str:
        """Name of the tool that is on, "" for none."""
        return self._tool

    @property
    def moving(self) -> bool:
        """Whether a joint moves or a trajectory is not over."""
        return self._reference is not None or self._motion.moving

    @property
    def zero_pose(self) -> tuple[float, float]:
        """Roll and tilt (rad), as the encoders see them, where the sensor was last zeroed."""
        return self._zero_pose

    @property
    def wrench_delay_ns(self) -> int:
        """How much later than the sample a wrench's stamp is."""
        return 0 if self._effects is None else self._effects.wrench_delay_ns

    @property
    def tracker_delay_ns(self) -> int:
        """How much later than the sample a tracker's stamp is."""
        return 0 if self._effects is None else self._effects.tracker_delay_ns

    @property
    def admittance_on(self) -> bool:
        """Whether the tip follows the wrench."""
        return self._admittance_on

    @property
    def hand_active(self) -> bool:
        """Whether the hand is at work."""
        return self._hand.active

    # --- commands ---------------------------------------------------------------------------

    def command(self, trajectory: Trajectory) -> None:
        """Follow a trajectory from the present state, instead of any other.

        Without points it means: stop. Raises PlantError and changes nothing when the
        trajectory is bad.
        """
        if not trajectory.points:
            self.stop()
            return
        motion_ns = self.now_ns + self._ahead_ns
        check_trajectory(trajectory, self._config.motion.limits, motion_ns)
        motion = self._motion
        start = JointState(
            [q - offset for q, offset in zip(motion.positions, self._offset, strict=True)],
            [v - own for v, own in zip(motion.velocities, self._offset_velocity, strict=True)],
            # In admittance mode the acceleration is mostly that of the sensor's noise.
            [0.0] * 5 if self._admittance_on else motion.accelerations,
        )
        hold = self._stopping_reference()
        self._reference = Reference(trajectory, motion_ns, start, hold)

    def stop(self) -> None:
        """Brake at the acceleration limits and stand."""
        self._hold = self._stopping_reference()
        self._reference = None

    def attach_tool(self, name: str) -> ToolGeometry | None:
        """Put a tool on, "" for none, and return it; raises PlantError."""
        if name and name not in self._config.tools:
            known = ", ".join(sorted(self._config.tools)) or "none"
            raise PlantError(f"no tool '{name}' here; configured: {known}")
        tool = self._config.tools[name] if name else None
        self._tool = name
        self._set_load(tool)
        self._sensor.spoil_zeroing("the tool was changed")
        return tool

    def start_zeroing(self, window_s: float) -> Zeroing:
        """Zero the sensor at the mean of the next `window_s`; ask `done` and `error` of the result.

        Raises PlantError while the arm moves or is in admittance mode.
        """
        if self._admittance_on:
            raise PlantError("the arm is in admittance mode")
        if self.moving:
            raise PlantError("the arm is moving")
        self._zeroing = self._sensor.start_zeroing(max(1, round(window_s / self._period_s)))
        return self._zeroing

    def set_admittance(self, on: bool) -> None:
        """Let the tip follow the wrench that `feed_admittance` brings, or stop it where it is."""
        if on == self._admittance_on:
            return
        self._admittance_on = on
        self._admittance.forget()
        if on:
            self._sensor.spoil_zeroing("admittance mode was switched on")
        else:
            # What the hand did stays: the reference moves to where the arm is.
            self._offset, self._offset_velocity = [0.0] * 5, [0.0] * 5
            self.stop()

    def feed_admittance(self, stamp_ns: int, wrench: Sequence[float]) -> None:
        """Give a wrench (6,) in ft_sensor about its origin, N and N.m, to follow."""
        self._admittance.feed(stamp_ns, wrench)

    def forget_admittance(self) -> None:
        """Drop the wrench to follow, for example when its source changes."""
        self._admittance.forget()

    def start_hand(self) -> None:
        """Play the hand's script from its beginning."""
        self._hand.start(self.now_ns)

    def push(self, push: HandPush) -> None:
        """Push once, from now on; raises PlantError, or ConfigError for nonsense."""
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
        if effects is None:
            now = None
            true, matrix = joints, sensor_matrix(joints[3], joints[4])
            # Gravity in ft_sensor is R^T (0, 0, -g).
            gx, gy, gz = -_G * matrix[6], -_G * matrix[7], -_G * matrix[8]
            mass, (hx, hy, hz) = self._mass, self._moment
        else:
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
        if effects is not None and now is not None:
            more = effects.more_wrench(now, velocities, motion.accelerations)
            if more is not None:
                wrench = [a + b for a, b in zip(wrench, more, strict=True)]
        touch = self._hand.wrench_at_tip(now_ns, matrix)
        if touch is not None:
            lever = cross(self._tip, touch[:3])
            for axis in range(3):
                wrench[axis] += touch[axis]
                wrench[axis + 3] += touch[axis + 3] + lever[axis]
        if effects is None:
            reading = self._sensor.read(wrench)
        else:
            reading = self._sensor.read(effects.before_noise(wrench), effects.after_noise)
        if self._zeroing is not None and self._zeroing.done:
            if self._zeroing.error is None:
                self._zero_pose = (joints[3], joints[4])
            self._zeroing = None

        encoded = self._encode(joints)
        oldest, window_s = self._encoded[0], self._window_s
        told_velocities = [(a - b) / window_s for a, b in zip(encoded, oldest, strict=True)]
        self._encoded.append(encoded)

        tracked = None
        due = int(self._count * self._config.tracker.rate_hz * self._period_s + 1e-9)
        if due > self._tracker_count:
            self._tracker_count = due
            tracked = self._look(true, matrix, touch, now)
        return Sample(
            now_ns,
            true.copy(),
            velocities.copy(),
            encoded,
            told_velocities,
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
        if not self._admittance_on:
            return reference
        joints = self._motion.positions
        velocities = self._admittance.joint_velocities(
            now_ns, joints, sensor_matrix(joints[3], joints[4]), self._tip
        )
        # The hand's part changes its velocity by no more than half of what the joints can: a step
        # of it (noise alone makes some) on top of the reference's own acceleration would be more
        # than they follow, and a joint that has lost a moving reference catches up only late.
        velocities = [
            min(max(wanted, now - step), now + step)
            for wanted, now, step in zip(
                velocities or [0.0] * 5, self._offset_velocity, self._offset_step, strict=True
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
        """The reference that makes every joint brake now; admittance goes on adding its part."""
        stops = self._motion.stopping_positions(self._offset_velocity)
        return [q - offset for q, offset in zip(stops, self._offset, strict=True)]

    def _set_load(self, tool: ToolGeometry | None) -> None:
        """Mass and first moment (SI) of all that hangs on the sensor; they only add up."""
        moments = self._config.adapter.moments + (tool.load.moments if tool else 0.0)
        self._mass = float(moments[0])
        self._moment = moments[1:].tolist()
        if self._effects is not None:
            self._effects.attach(tool)
        # Without a tool there is no tip; a hand then holds the sensor's own origin.
        self._tip = np.asarray(tool.tip_m, dtype=float).tolist() if tool else [0.0, 0.0, 0.0]

    def _encode(self, joints: Sequence[float]) -> list[float]:
        return [
            round(value / step) * step
            for value, step in zip(joints, self._config.encoder_quantum, strict=True)
        ]

    def _look(
        self,
        joints: Sequence[float],
        matrix: Matrix,
        touch: Sequence[float] | None,
        now: ArmNow | None,
    ) -> TrackerSample:
        effects = self._effects
        seen = None if effects is None else effects.seen
        base_shift = None if effects is None else effects.base_shift()
        if not self._tool:
            return self._tracker.sample(None, None, seen, base_shift)
        deflection = None
        if touch is not None:
            key = (tuple(joints), self._tool)
            if key != self._compliance_of:
                self._compliance = tip_compliance(joints, self._tip, self._arm)
                self._compliance_of = key
            deflection = (self._compliance @ _in_base(matrix, touch)).tolist()
        if effects is None or now is None:
            position = self._geometry.tip_position(joints, matrix, self._tip)
            tip = (position, sensor_quaternion(joints[3], joints[4]))
            return self._tracker.sample(tip, deflection)
        at_tip = [0.0] * 6 if touch is None else _in_base(matrix, touch)
        more = effects.more_deflection(now, at_tip, deflection or [0.0] * 6)
        if more is not None:
            deflection = [a + b for a, b in zip(deflection or [0.0] * 6, more, strict=True)]
        tip = (effects.position(now, self._tip), effects.quaternion(now))
        return self._tracker.sample(tip, deflection, seen, base_shift)


def _effects_at_work(config: PlantConfig) -> PlantEffects | None:
    """The effects that change something; None where none does."""
    effects = [effect for effect in config.effects if not effect.changes_nothing]
    if not effects:
        return None
    return PlantEffects(effects, config.arm, config.adapter, HOME.tolist())


def _in_base(matrix: Matrix, touch: Sequence[float]) -> list[float]:
    """A wrench (6,) about tool_tip, from its axes to those of base_link."""
    return [*rotate(matrix, touch[:3]), *rotate(matrix, touch[3:])]
