"""What a diagnosis needs of an effect is in one record."""

from pathlib import Path

import pytest
from galen_diagnosis.effects.diagnosed_effect import no_forms
from galen_diagnosis.effects.registry import RECORDS, record_of, sought
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.registry import EFFECTS

import galen_diagnosis

ROOMS = ("answer", "experiment", "inference", "observation", "report", "tables")


def test_every_simulated_effect_has_a_record():
    assert set(RECORDS) - set(EFFECTS) == {"encoder_delay", "gear_error"}  # of a joint's two ends
    assert set(EFFECTS) <= set(RECORDS)


def test_an_effect_that_is_looked_for_shows_in_some_form():
    for identity in sought(GALEN):
        record = record_of(identity)
        hooks = (record.forms, record.columns, record.limits)
        assert record.jump is not None or any(hook is not no_forms for hook in hooks), identity


@pytest.mark.parametrize("room", ROOMS)
def test_no_other_room_names_an_effect(room):
    for file in (Path(galen_diagnosis.__file__).parent / room).rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert not [name for name in RECORDS if f'"{name}"' in text], file
