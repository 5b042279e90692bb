"""Parameters of the node."""

from dataclasses import dataclass

import numpy as np
from galen_gravcomp.frozen import FROZEN_S
from galen_model.arm import JOINT_NAMES
from galen_ros.param import param

from galen_deflection.deflector import DeflectorSettings


@dataclass(frozen=True)
class DeflectionParameters:
    """Parameters of the node. Times of samples are by their stamps."""

    model_file: str = param(
        "",
        "file of the model, as `train` writes it; `~` is expanded; empty: nothing is published."
        " Setting it again reads it again; a file that can't be used is refused, and the model in"
        " force stays",
        read_only=False,
    )
    publish_tip_pose: bool = param(True, "whether to publish `tip_pose_corrected`")
    sensor_frame: str = param("ft_sensor", "frame_id that `wrench_compensated` must have")
    joint_names: tuple[str, ...] = param(
        JOINT_NAMES,
        "names in `joint_states` of the platform's x, y and z, of roll and of tilt, in this order",
    )
    max_joint_age_s: float = param(
        0.05,
        "s; how far `joint_states` may lie behind a wrench, and how far apart two joint samples"
        " may be to interpolate between them",
        minimum=0.001,
        maximum=1.0,
    )
    memory_gap_s: float = param(
        0.1,
        "s; after a longer time without a usable wrench, loads may have come and gone unseen: the"
        " hysteresis is forgotten",
        minimum=0.002,
        maximum=10.0,
    )
    restart_gap_s: float = param(
        1.0,
        "s; a longer gap in the stamps of a topic means that the driver was restarted",
        minimum=0.1,
        maximum=60.0,
    )
    silence_s: float = param(
        1.0,
        "s of wall time without a message after which a topic is called silent",
        minimum=0.1,
        maximum=60.0,
    )
    frozen_s: float = param(
        FROZEN_S,
        "s of wall time that a wrench may stay the same to the last bit while roll or tilt turns;"
        " then it is refused: the sensor hangs; 0: for ever",
        minimum=0.0,
        maximum=60.0,
    )
    best_effort_input: bool = param(
        False, "subscribe as best effort, for a compensation that publishes its wrench so"
    )
    sensor_range: tuple[float, ...] = param(
        (125.0, 125.0, 500.0, 3.0, 3.0, 3.0),
        "N, N.m; range of the sensor's axes fx fy fz tx ty tz; a wrench beyond it gives a warning",
        minimum=1e-6,
    )
    gravcomp_node: str = param(
        "gravcomp",
        "name of the compensation's node, whose tool and tare are followed on `/diagnostics`;"
        " empty: they are not",
    )

    def validate(self) -> None:
        """Check what no single range can say."""
        count = len(JOINT_NAMES)
        if len(self.joint_names) != count or len(set(self.joint_names)) != count:
            raise ValueError(
                f"parameter 'joint_names' is {list(self.joint_names)}, but must name five joints:"
                " x, y and z of the platform, roll and tilt"
            )
        if len(self.sensor_range) != 6:
            raise ValueError(
                f"parameter 'sensor_range' has {len(self.sensor_range)} numbers, but must have 6"
            )

    def settings(self) -> DeflectorSettings:
        """The deflector's part of the parameters."""
        return DeflectorSettings(
            max_joint_age_s=self.max_joint_age_s,
            restart_gap_s=self.restart_gap_s,
            sensor_frame=self.sensor_frame,
            sensor_range=np.array(self.sensor_range),
            memory_gap_s=self.memory_gap_s,
        )
