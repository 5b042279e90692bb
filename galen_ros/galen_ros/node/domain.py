"""A ROS domain id that no other process of this suite on this machine has."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from pathlib import Path
from typing import IO

# Fast DDS takes UDP port 7400 + 250 domain and up. Linux hands out ports from 32768 to everybody,
# which is domain 101; people use the low domains.
_DOMAIN_IDS = range(61, 101)


class DomainLock:
    """Holds a ROS domain id that no other process of this suite holds: a test, a demonstration."""

    def __init__(self, timeout_s: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_s
        count = len(_DOMAIN_IDS)
        first = os.getpid() % count
        while True:
            for step in range(count):
                domain_id = _DOMAIN_IDS[(first + step) % count]
                handle = _try_lock(domain_id)
                if handle is not None:
                    self.domain_id = domain_id
                    self._handle = handle
                    return
            if time.monotonic() > deadline:
                raise TimeoutError(f"no free ROS domain id among {_DOMAIN_IDS} for {timeout_s} s")
            time.sleep(0.1)

    def release(self) -> None:
        """Give the domain id back."""
        self._handle.close()


def _try_lock(domain_id: int) -> IO[str] | None:
    """Lock a domain's file; the system releases it when the process ends, however it ends."""
    path = Path(tempfile.gettempdir()) / f"galen_ros_domain_{domain_id}.lock"
    try:
        handle = path.open("a")
    except PermissionError:  # another user's
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        handle.close()
        return None
    return handle
