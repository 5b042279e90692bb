"""Parameters of the node."""

from dataclasses import dataclass

from galen_model.arm.galen import JOINT_NAMES
from galen_ros.parameters import param
from galen_ros.stream.pairing import StreamParameters


@dataclass(frozen=True)
class DeflectionParameters(StreamParameters):
    """Parameters of the node. Times of samples are by their stamps."""

    model_file: str = param(
        "",
        "file of the model, as `train` writes it; `~` is expanded; empty: nothing is published."
        " Setting it again reads it again; a file that can't be used is rejected, and the model in"
        " force stays",
        read_only=False,
    )
    publish_tip_pose: bool = param(True, "whether to publish `tip_pose_corrected`")
    sensor_frame: str = param("ft_sensor", "frame_id that `wrench_compensated` must have")
    joint_names: tuple[str, ...] = param(
        JOINT_NAMES,
        "names in `joint_states` of the platform's x, y and z, of roll and of tilt, in this order",
    )
    memory_gap_s: float = param(
        0.1,
        "s; after a longer time without a usable wrench, loads may have come and gone unseen: the"
        " hysteresis is forgotten",
        minimum=0.002,
        maximum=10.0,
    )
    gravcomp_node: str = param(
        "gravcomp",
        "name of the compensation's node, whose tool and tare are followed on `/diagnostics`;"
        " empty: they are not",
    )

    def validate(self) -> None:
        """Check what no single range can say."""
        super().validate()
        count = len(JOINT_NAMES)
        if len(self.joint_names) != count or len(set(self.joint_names)) != count:
            raise ValueError(
                f"parameter 'joint_names' is {list(self.joint_names)}, but must name five joints:"
                " x, y and z of the platform, roll and tilt"
            )
