# SPDX-License-Identifier: Apache-2.0
"""The Galen by Pinocchio: the second method that closed forms are tested against."""

import numpy as np
import pinocchio
from galen_model.arm.galen import GALEN, TIP_FRAME, galen_urdf
from galen_model.arrays import Array
from numpy.typing import ArrayLike


class PinocchioArm:
    """Frame poses and Jacobians of the arm with a tip at tip_m (3,) in ft_sensor."""

    def __init__(self, tip_m: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Build the model from the URDF."""
        self.model = pinocchio.buildModelFromXML(galen_urdf(GALEN, tip_m))
        self._data = self.model.createData()
        assert tuple(self.model.names[1:]) == GALEN.joint_names

    def pose(self, joints: ArrayLike, frame: str = GALEN.sensor_frame) -> tuple[Array, Array]:
        """Return a frame's pose.

        Args:
            joints: Joints in the arm's order, (5,), m and rad.
            frame: Name of the frame in the URDF.

        Returns:
            R_base_frame (3, 3), and the frame's origin in base_link (3,), m.

        """
        pinocchio.framesForwardKinematics(self.model, self._data, np.asarray(joints, dtype=float))
        placement = self._data.oMf[self.model.getFrameId(frame)]
        return placement.rotation.copy(), placement.translation.copy()

    def jacobian(self, joints: ArrayLike, frame: str = TIP_FRAME) -> Array:
        """Return a frame's Jacobian.

        Args:
            joints: Joints in the arm's order, (5,), m and rad.
            frame: Name of the frame in the URDF.

        Returns:
            Jacobian (6, 5): linear, then angular velocity of the frame in base_link's axes.

        """
        return np.asarray(
            pinocchio.computeFrameJacobian(
                self.model,
                self._data,
                np.asarray(joints, dtype=float),
                self.model.getFrameId(frame),
                pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED,
            )
        )
