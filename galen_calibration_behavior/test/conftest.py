# SPDX-License-Identifier: Apache-2.0
"""What tests of calibrations share."""

import pytest


@pytest.fixture
def plain_fit(monkeypatch):
    """No models are compared, which takes a second and more of each calibration."""
    monkeypatch.setattr("galen_model.load.choice.MIN_POSES_TO_REJECT", 1000)
