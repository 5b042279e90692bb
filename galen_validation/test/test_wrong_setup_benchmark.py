# SPDX-License-Identifier: Apache-2.0
"""A driver that makes a mistake, as a process of its own, is told of by gravcomp_node."""

import pytest

from galen_validation.wrong_setup import MISTAKES, measure

WORDS = {
    "reversed reading": "the reading is reversed",
    "sensor upside down": "turned by 180 deg about x",
    "forces in kgf": "forces are in kgf",
    "torques in N.mm": "in N.mm",
    "angles in degrees": "are they in degrees?",
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", WORDS)
def test_the_verdict_of_real_processes_names_the_mistake(mistake, tmp_path):
    found = measure(MISTAKES[mistake], tmp_path)
    assert WORDS[mistake] in found.text
    assert found.published < 2000  # 4 s: it was rejected, and not for silence
