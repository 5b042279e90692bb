"""Parameters of every node that takes a wrench and joint_states."""

from dataclasses import dataclass

from galen_ros.parameters import param
from galen_ros.stream.watches import FROZEN_S, LATE_S


@dataclass(frozen=True)
class StreamParameters:
    """Limits of the samples, by their stamps, and when a topic is silent."""

    max_joint_age_s: float = param(
        0.05,
        "s; how far `joint_states` may lie behind a wrench, and how far apart two joint samples"
        " may be to interpolate between them",
        minimum=0.001,
        maximum=1.0,
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
    best_effort_input: bool = param(
        False, "subscribe as best effort, for who publishes the wrench or the joints so"
    )
    frozen_s: float = param(
        FROZEN_S,
        "s of wall time that a wrench may stay the same to the last bit while roll or tilt turns;"
        " then it is rejected: the sensor hangs; 0: for ever",
        minimum=0.0,
        maximum=60.0,
    )
    late_s: float = param(
        LATE_S,
        "s; a wrench that takes so much longer from its stamp to its arrival than the fastest of"
        " the last 5 to 10 s gives a warning, and goes out; 0: none does. Not watched with"
        " `use_sim_time`",
        minimum=0.0,
        maximum=60.0,
    )
    sensor_range: tuple[float, ...] = param(
        (125.0, 125.0, 500.0, 3.0, 3.0, 3.0),
        "N, N.m; range of the sensor's axes fx fy fz tx ty tz; a wrench beyond it gives a warning",
        minimum=1e-6,
    )

    def validate(self) -> None:
        """Check what no single range can say."""
        if len(self.sensor_range) != 6:
            raise ValueError(
                f"parameter 'sensor_range' has {len(self.sensor_range)} numbers, but must have 6"
            )
