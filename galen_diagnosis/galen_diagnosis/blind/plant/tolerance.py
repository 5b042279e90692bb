"""How a healthy arm differs from the nominal one: what workshops and calibrations leave.

None of it is anybody's effect; each is about a hundredth to a third of what is called a clear one.
Standard deviations; drawn normally, cut at two of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm, Body

SIZES: tuple[tuple[str, int, float], ...] = (
    # Lengths: +-0.1 mm (two sigma), a fine workshop's general tolerance (ISO 2768-f, to 120 mm
    # +-0.15, calibrated to 2/3 of it).
    ("length_m", 6, 0.05e-3),
    ("rod_length_m", 1, 0.05e-3),
    # Squareness of the two axes: 0.05 mm over 0.5 m.
    ("axis_rad", 3, 0.1e-3),
    # Joint zeros: found with a level of 0.1 mrad; the platform's with a gauge of 0.02 mm.
    ("angle_zero_rad", 2, 0.1e-3),
    # The sensor's base levelled with the same level.
    ("level_rad", 2, 0.1e-3),
    # Stiffness: +-1 % (two sigma), what a static test on the arm repeats.
    ("stiffness", 4, 0.005),
    # Sensor gains: 0.05 % (two sigma), what is left after the maker's matrix and an adjustment.
    ("sensor_gain", 6, 0.25e-3),
    # Where the platform really is at each of four places: rods that differ by 0.02 mm shift it by
    # as much, and turn it by that over a pair's spacing of 110 mm, 0.2 mrad, of which a
    # calibration of the arm leaves a sixth.
    ("place_m", 12, 0.02e-3),
    ("place_rad", 12, 0.03e-3),
    # The tracker's scale: 0.12 mm over a volume of some 2.5 m.
    ("tracker_scale", 1, 0.05e-3),
    # Transmission of roll and tilt: eccentricity of encoders and gears, an arc minute a turn.
    ("transmission", 2, 0.1e-3),
    # The tool's file: 56 poses of about 100 samples leave 20 mN / sqrt(5600) / g = 0.03 g, and of
    # the first moment 0.4 mN.m / sqrt(5600) / g: 10 um of a centre of 60 g.
    ("mass_kg", 1, 0.03e-3),
    ("moment_kg_m", 3, 0.6e-6),
    # A sample is stamped when it is read: within a fraction of a period of 2 to 10 ms.
    ("wrench_late_s", 1, 0.3e-3),
    # A camera's exposure and way, known to a fraction of a period of some 16 ms.
    ("tracker_late_s", 1, 1.0e-3),
)
"""Name, how many, standard deviation of each."""

NAMES = tuple(name for name, count, _ in SIZES for _ in range(count))
COUNT = len(NAMES)


@dataclass(frozen=True)
class Tolerance:
    """The differences of one arm, in standard deviations (COUNT,) in the order of SIZES."""

    sigmas: Array

    def part(self, name: str) -> Array:
        """One of them in its own unit."""
        at = 0
        for own, count, size in SIZES:
            if own == name:
                return size * self.sigmas[at : at + count]
            at += count
        raise KeyError(name)

    def arm(self, arm: BlindArm) -> BlindArm:
        """The arm with these differences."""
        length = self.part("length_m")
        axis = self.part("axis_rad")
        level = self.part("level_rad")
        stiffness = 1.0 + self.part("stiffness")
        turn = np.array([0.0, 0.0, 0.0, *self.part("angle_zero_rad")])
        return replace(
            arm,
            roll_to_tilt_m=arm.roll_to_tilt_m + length[:3],
            tilt_to_sensor_m=arm.tilt_to_sensor_m + length[3:],
            rod_length_m=arm.rod_length_m + float(self.part("rod_length_m")[0]),
            roll_axis=arm.roll_axis + np.array([0.0, axis[0], axis[1]]),
            tilt_axis=arm.tilt_axis + np.array([axis[2], 0.0, 0.0]),
            joint_zero=arm.joint_zero + turn,
            joint_gain=arm.joint_gain + np.array([0.0, 0.0, 0.0, *self.part("transmission")]),
            gravity=arm.gravity - np.cross([*level, 0.0], arm.gravity),
            k_roll=arm.k_roll * stiffness[0],
            k_tilt=arm.k_tilt * stiffness[1],
            k_carriage=arm.k_carriage * stiffness[2],
            k_rod=arm.k_rod * stiffness[3],
            places=np.column_stack(
                [self.part("place_m").reshape(4, 3), self.part("place_rad").reshape(4, 3)]
            ),
            tracker_scale=1.0 + float(self.part("tracker_scale")[0]),
            sensor_gain=arm.sensor_gain * (1.0 + self.part("sensor_gain")),
        )

    def late_s(self, of: str) -> float:
        """By how much samples of "wrench" or "tracker" are older than their stamps say."""
        return float(self.part(f"{of}_late_s")[0])

    def tool(self, tool: Body) -> Body:
        """The tool as it is, of what its file says."""
        mass = tool.mass_kg + float(self.part("mass_kg")[0])
        moment = tool.mass_kg * tool.com_m + self.part("moment_kg_m")
        return replace(tool, mass_kg=mass, com_m=moment / mass)


def draw_tolerance(seed: int, scale: float = 1.0) -> Tolerance:
    """The healthy arm of a seed; scale 0 is the nominal one."""
    rng = np.random.default_rng([seed, 2])
    return Tolerance(scale * np.clip(rng.standard_normal(COUNT), -2.0, 2.0))


NOMINAL = Tolerance(np.zeros(COUNT))
