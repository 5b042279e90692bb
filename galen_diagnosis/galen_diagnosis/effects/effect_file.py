"""The effect that was found, as parameters of the simulated driver."""

from __future__ import annotations

import yaml
from galen_sim_driver.node.effect_parameters import driver_file

from galen_diagnosis.answer.result import Diagnosis

_HEAD = """\
# What the diagnosis of {recording} found, for the simulated driver:
# {causes}
#
#   ros2 run galen_sim_driver sim_driver_node --ros-args --params-file THIS_FILE
"""


def effect_file(diagnosis: Diagnosis) -> str | None:
    """The YAML's text; None where no effect was found. Raises ConfigError.

    The driver has one of each effect, so that two of a kind are rejected.
    """
    if not diagnosis.effects:
        return None
    head = _HEAD.format(
        recording=_one_line(diagnosis.answer.recording),
        causes=", ".join(effect.identity for effect in diagnosis.effects),
    )
    content = {f"/**/{node}": below for node, below in driver_file(diagnosis.effects).items()}
    return head + yaml.safe_dump(content, sort_keys=False)


def _one_line(text: str) -> str:
    """Without what would end a comment: a recording's name is whatever its directory is called."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
