# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis needs of an effect is in one record."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from galen_common.parameters import param
from galen_diagnosis.effects import registry
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, no_forms
from galen_diagnosis.effects.registry import RECORDS, record_of, sought
from galen_diagnosis.inference import search
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.report.words import next_steps
from galen_diagnosis.simulated_recording import make_recording
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.effect import Effect, Fitted
from galen_sim_driver.effects.load import InertialLoad
from galen_sim_driver.effects.registry import EFFECTS

ROOMS = ("answer", "experiment", "inference", "observation", "report", "tables")


def test_every_simulated_effect_has_a_record():
    of_a_joints_two_ends = {"encoder_delay", "gear_error"}
    assert set(RECORDS) == set(EFFECTS) | of_a_joints_two_ends


def test_an_effect_that_is_looked_for_shows_in_some_form():
    for identity in sought(SimpleNamespace(arm=GALEN, readings=None)):
        record = record_of(identity)
        hooks = (record.forms, record.columns, record.limits)
        assert record.jump is not None or any(hook is not no_forms for hook in hooks), identity


@pytest.mark.parametrize("room", ROOMS)
def test_no_other_room_names_an_effect(room):
    for file in (Path(registry.__file__).parents[1] / room).rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert not [name for name in RECORDS if f'"{name}"' in text], file


@pytest.mark.parametrize(
    ("mass_kg", "own", "inertial_forces", "can_be"),
    [(0.3, 1e-4, False, True), (0.01, 1e-4, False, False), (0.01, 0.0, False, True),
     (0.7, 1e-4, False, False), (0.01, 1e-4, True, True)],
)  # fmt: skip
def test_a_body_accelerates_with_the_mass_of_the_file(mass_kg, own, inertial_forces, can_be):
    tool = SimpleNamespace(load=SimpleNamespace(mass_kg=0.2), adapter=SimpleNamespace(mass_kg=0.1))
    recording = SimpleNamespace(tool=tool, inertial_forces=inertial_forces)
    effect = InertialLoad(mass_kg, (own,) * 3 + (0.0,) * 3)
    assert RECORDS[effect.name].plausible(effect, recording) is can_be


def test_what_cannot_be_so_is_no_seed_of_sets(monkeypatch):
    own = (1e-4,) * 3 + (0.0,) * 3
    load = SimpleNamespace(mass_kg=0.25)
    tool = SimpleNamespace(load=load, adapter=load)
    observation = SimpleNamespace(recording=SimpleNamespace(tool=tool, inertial_forces=False))
    parts = [SimpleNamespace(effect=InertialLoad.name)]
    for mass_kg, can_be in ((0.01, False), (0.4, True)):
        fit = SimpleNamespace(effects=(InertialLoad(mass_kg, own_inertia_kg_m2=own),), cost=0.0)
        monkeypatch.setattr(search, "refine", lambda *_, fit=fit: fit)
        discrepancies = SimpleNamespace(on_the_way=lambda *_: None, weigh=lambda _, fit, cost: fit)
        fits = search._Fits(observation, SimpleNamespace(behind=None), discrepancies, fit)
        assert fits.of(parts, [None]) == [fit] * can_be


@dataclass(frozen=True)
class Stretched(Effect):
    """fz reads `per_n` times the square of fx too much."""

    name = "stretched"
    fitted = (Fitted("per_n", "1/N", 0.01, -0.2, 0.2),)

    per_n: float = param(0.0, "how much fz reads too much, over the square of fx, 1/N")

    def read(self, when, wrench):
        read = wrench.copy()
        read[:, 2] += self.per_n * wrench[:, 0] ** 2
        return read


@pytest.mark.slow
def test_a_new_effect_is_found_with_a_class_and_a_record(tmp_path, monkeypatch):
    monkeypatch.setitem(EFFECTS, Stretched.name, Stretched)
    record = DiagnosedEffect(
        name=Stretched.name,
        title="stretched sensor",
        sentence="fz is stretched by {per_n}",
        remedy="buy another sensor",
    )
    monkeypatch.setitem(RECORDS, record.name, record)
    effects, bags = [Stretched(0.02)], ("sweep", "motion")
    make_recording(tmp_path / "recording", effects, seed=5, arm=GALEN, bags=bags)
    answer = diagnose_recording(read_recording(tmp_path / "recording")).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect) == ("identified", "stretched")
    interval = cause.parameters["per_n"]
    assert interval.low < 0.02 < interval.high
    assert answer.sentence.startswith("Fz is stretched by 0.0")
    assert next_steps(answer)[0] == "Buy another sensor."
