# SPDX-License-Identifier: Apache-2.0
"""Arrays of samples as a bag's messages are read, for `Compensator.push_block`."""

import numpy as np
from galen_bags.arrays.arm_recording import Samples


def topic(stamps, values, frame=None, frame_ids=("ft_sensor",), bad=None):
    """One topic's samples; joints may be roll and tilt alone."""
    values = np.asarray(values, dtype=float)
    if values.shape[1] == 2:
        values = np.column_stack([np.full((len(values), 3), np.nan), values])
    frame = np.zeros(len(values), dtype=int) if frame is None else np.asarray(frame, dtype=int)
    return Samples(np.asarray(stamps, dtype=np.int64), values, frame, tuple(frame_ids), bad or {})
