"""Finding wanted joints among a JointState's names, without ROS."""

from __future__ import annotations

from collections.abc import Sequence

from galen_model.errors import GalenError


class JointStateError(GalenError):
    """A JointState can't be read."""


class UnknownJointError(JointStateError):
    """A JointState lacks joints that are needed; the message names them, and those it has."""


def joint_indices(wanted: Sequence[str], names: Sequence[str]) -> tuple[int, ...]:
    """Where each wanted joint is among `names`; raises UnknownJointError."""
    missing = [name for name in wanted if name not in names]
    if missing:
        raise UnknownJointError(
            f"joint state lacks {', '.join(missing)}; it has {', '.join(names) or 'no joints'}"
        )
    return tuple(names.index(name) for name in wanted)


def check_joint_counts(names: int, positions: int, velocities: int) -> None:
    """Raise JointStateError unless every name has a position, and all or none a velocity."""
    if positions != names:
        raise JointStateError(f"joint state has {names} names but {positions} positions")
    if velocities not in (0, names):
        raise JointStateError(f"joint state has {names} names but {velocities} velocities")
