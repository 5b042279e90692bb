import shutil

import numpy as np
import pytest
from galen_bags.formats.writer import BagWriter
from galen_diagnosis.blind.making import same_times
from galen_diagnosis.blind.plant import writing
from galen_diagnosis.blind.plant.listed import CAUSES
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import draw_session
from galen_diagnosis.blind.scoring.metadata import chance, metadata, table

SORTS = ("none", "joint_zero_offset:tilt", "sensor_saturation", "wrench_delay")


def record(folder, seed, cause):
    """A recording of the motion alone, as the check makes it, and its metadata."""
    session = draw_session(seed, ("motion",))
    causes = []
    if cause != "none":
        causes = [CAUSES[cause].draw(np.random.default_rng(seed), session)]
    recording = folder / f"recording_{seed:06x}"
    recording.mkdir(parents=True)
    writing.write_recording(recording, Machine(session, causes))
    same_times(recording)
    found = metadata(recording)
    shutil.rmtree(recording)
    return found


def test_one_session_has_the_same_metadata_whatever_its_cause(tmp_path, monkeypatch):
    first, *others = (record(tmp_path, 7, cause) for cause in ("none", *SORTS[2:]))
    assert len(first) > 20
    assert all(other == first for other in others)

    # A writer that compresses gives away how much there is to tell: that would be seen.
    class Compressing(BagWriter):
        def __init__(self, path, **options):
            super().__init__(path, **{**options, "compressed": True})

    monkeypatch.setattr(writing, "BagWriter", Compressing)
    tight = [record(tmp_path, 7, cause) for cause in ("none", "sensor_saturation")]
    assert tight[0] != tight[1]


@pytest.mark.slow
def test_no_classifier_tells_causes_from_metadata(tmp_path):
    causes = [SORTS[number % len(SORTS)] for number in range(16)]
    found = [record(tmp_path, 100 + number, cause) for number, cause in enumerate(causes)]
    honest = chance(table(found), causes)
    assert honest.p > 0.01, honest
    # The same recordings, the length of whose names goes by the cause.
    leaking = [{**one, "name length": float(len(c))} for one, c in zip(found, causes, strict=True)]
    assert chance(table(leaking), causes).p < 0.01


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_the_classifier_finds_a_leak_among_many_columns(spread):
    random = np.random.default_rng(11)
    causes = [SORTS[number % len(SORTS)] for number in range(40)]
    plain = random.normal(size=(40, 20))
    assert chance(plain, causes).p > 0.05
    leak = np.array([SORTS.index(cause) for cause in causes]) + spread * random.normal(size=40)
    found = chance(np.column_stack([plain, leak]), causes)
    assert found.p < 0.01 and found.share > 0.6 > found.by_chance


def test_the_classifier_keeps_its_level():
    """Of 40 honest sets 5 % may look like a leak at p = 0.05."""
    random = np.random.default_rng(5)
    causes = [SORTS[number % len(SORTS)] for number in range(20)]
    low = sum(
        chance(random.normal(size=(20, 6)), causes, draws=40, seed=number).p <= 0.05
        for number in range(40)
    )
    assert low <= 6  # more has a probability below 0.01
    assert chance(np.zeros((20, 0)), causes).p == 1.0
