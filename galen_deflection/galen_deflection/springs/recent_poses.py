"""What hangs on the joints alone, kept while the arm stands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from galen_model.arrays import Array

T = TypeVar("T")

_KEPT = 64


class RecentPoses(Generic[T]):
    """Calculates something of joints (n, 5), and remembers it for the last single joint vectors.

    Live, one sample comes at a time, and an arm that stands while it is pushed reports a few
    joint vectors again and again, since its encoders have steps. Only an equal vector, to the last
    bit, gets what was calculated before: nothing is approximated.
    """

    def __init__(self, calculate: Callable[[Array], T]) -> None:
        """What `calculate` gives must not be changed by who gets it."""
        self._calculate = calculate
        self._kept: dict[bytes, T] = {}

    def __call__(self, joints: Array) -> T:
        """Of joints (n, 5)."""
        if len(joints) != 1:
            return self._calculate(joints)
        key = joints.tobytes()
        found = self._kept.get(key)
        if found is None:
            found = self._calculate(joints)
            if len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = found
        return found
