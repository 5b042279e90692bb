"""The rule of rest, and how it is applied.

The arm is at rest while no joint goes further in a window than its limit of speed allows, beside
steps of its encoder: one step of 5e-5 rad between two samples, 2 ms apart, would be 0.025 rad/s.
The wrench is steady while it changes from window to window by no more than its noise makes it.

The forms differ in what they see and in what they must say, and so in windows and limits:

- `segments`: rows of a recording, by joints or by gravity's direction alone. No wrench: a recording
  of a calibration holds contacts that the estimator has to see.
- `binned`: time bins of hours of a compensated wrench, the noise known from the whole recording.
- `windows`: a live stream, sample by sample, the noise learned from what came before. A segment
  can't be looked back into, so that windows are of one length and begin where the arm came to rest.
- `pose`: one averaged pose, compared with the other poses of its sweep.
"""

from __future__ import annotations

from typing import Any


def allowed_travel(max_speed: Any, window_s: float, quantum: Any, steps: float = 1.0) -> Any:
    """Return how far a joint at rest may go in a window, m or rad.

    A range over many samples holds a step of the encoder at both of its ends: steps = 2.
    """
    return max_speed * window_s + steps * quantum
