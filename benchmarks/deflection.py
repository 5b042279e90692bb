"""What `benchmarks.bench` measures of the deflection's process.

The models are the nominal arm's: springs, and springs with two smooth plays at each, as fits to
arms with friction come out. The arm moves, so that no joint vector comes twice; `stands` is the
same with one joint vector, of which less has to be calculated.
"""

from collections.abc import Sequence
from pathlib import Path

from geometry_msgs.msg import PoseStamped

from benchmarks.node import Subject
from galen_msgs.msg import DeflectionStamped


def subjects(models: Sequence[Path], wrench_topic: str) -> list[Subject]:
    """The node with each model, which hears the compensated wrench on `wrench_topic`."""
    out = []
    for model in models:
        arguments = (
            *("galen_deflection.node", "--ros-args", "--log-level", "error"),
            *("-r", f"wrench_compensated:={wrench_topic}", "-p", f"model_file:={model}"),
        )
        given = ("deflection", DeflectionStamped)
        others = (("tip_pose_corrected", PoseStamped),)
        name = f"deflection, {model.stem}"
        out.append(Subject(name, arguments, given, others, moving=True))
        out.append(Subject(f"{name}, stands", arguments, given, others))
    return out
