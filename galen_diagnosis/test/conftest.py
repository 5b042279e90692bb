# SPDX-License-Identifier: Apache-2.0
"""A healthy arm's recording, which tests of several files read."""

import pytest
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.simulated_recording import make_recording
from galen_model.arm.galen import GALEN


@pytest.fixture(scope="session")
def healthy_sweep(tmp_path_factory):
    """The Galen's whole sweep with the pointer, by an arm that nothing is wrong with."""
    folder = tmp_path_factory.mktemp("healthy") / "made"
    make_recording(folder, seed=3, bags=("sweep",), arm=GALEN)
    return read_recording(folder)
