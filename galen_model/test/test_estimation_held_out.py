# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.estimation.held_out import held_out
from galen_model.load.model import gravity_regressor
from galen_model.load.readings import LoadReadings

BLOCKS = np.repeat(np.arange(8), 5)


@pytest.fixture
def problem():
    """40 readings of 0.3 kg, of which the first component of gravity shows in block 3 alone."""
    random = np.random.default_rng(4)
    gravity = random.standard_normal((40, 3))
    gravity[BLOCKS != 3, 0] = 0.0
    gravity *= 9.80665 / np.linalg.norm(gravity, axis=1, keepdims=True)
    wrench = gravity_regressor(gravity) @ [0.3, 0.001, 0.002, 0.02]
    wrench = wrench + random.standard_normal((40, 6)) * ([0.02] * 3 + [5e-4] * 3)
    return LoadReadings.of_orientations(gravity, wrench, arm=GALEN).affine()


def test_blocks_held_out_together_are_predicted_as_one_by_one(problem):
    used = np.ones(40, dtype=bool)
    used[7] = False
    blocks = np.where(BLOCKS == 3, -1, BLOCKS)
    together = held_out(problem, used, blocks)
    for label in np.unique(blocks[blocks >= 0]):
        alone = held_out(problem, used, np.where(blocks == label, label, -1))
        for one, all_ in zip(alone, together, strict=True):
            np.testing.assert_allclose(one[blocks == label], all_[blocks == label], rtol=1e-6)
    assert np.all(np.isnan(together[0][blocks < 0]))


def test_a_block_without_which_a_parameter_is_open_is_not_predicted_and_the_others_are(problem):
    residuals, density = held_out(problem, np.ones(40, dtype=bool), BLOCKS)
    for found in (residuals, density):
        assert np.all(np.isnan(found[BLOCKS == 3]))
        assert np.all(np.isfinite(found[BLOCKS != 3]))
