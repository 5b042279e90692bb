# SPDX-License-Identifier: Apache-2.0
"""What tests of the compensation share."""

from collections.abc import Iterator

import pytest
from galen_ros.node.testing import Harness


@pytest.fixture
def harness() -> Iterator[Harness]:
    """A private ROS world."""
    with Harness() as harness:
        yield harness
