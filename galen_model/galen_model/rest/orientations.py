"""Find the still phases of a recording from its orientations.

Only the direction of gravity in the sensor counts, since the model sees nothing else: a phase is
still while that direction turns slower than a limit. Its rim is cut off, so that the end of a
motion, and what it leaves ringing, is not in the average.
"""

from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array


@dataclass(frozen=True)
class StillSettings:
    """When a phase counts as still."""

    max_rate_rad_s: float = 0.01
    rim_s: float = 0.5
    min_duration_s: float = 2.0


def still_phases(
    time: Array, gravity_sensor: Array, settings: StillSettings | None = None
) -> list[slice]:
    """Slices of the rows of each still phase; time (n,) s increasing, gravity (n, 3)."""
    settings = settings or StillSettings()
    if len(time) < 2:
        return []
    direction = gravity_sensor / np.linalg.norm(gravity_sensor, axis=1, keepdims=True)
    # a chord is shorter than the arc, by nothing that matters at such angles
    rate = np.linalg.norm(np.diff(direction, axis=0), axis=1) / np.diff(time)
    still = np.concatenate([[True], rate <= settings.max_rate_rad_s])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    phases = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        inside = (time[start:stop] >= time[start] + settings.rim_s) & (
            time[start:stop] <= time[stop - 1] - settings.rim_s
        )
        rows = start + np.flatnonzero(inside)
        if len(rows) and time[rows[-1]] - time[rows[0]] >= settings.min_duration_s:
            phases.append(slice(int(rows[0]), int(rows[-1]) + 1))
    return phases
