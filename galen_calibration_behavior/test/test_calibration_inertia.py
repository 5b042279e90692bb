# SPDX-License-Identifier: Apache-2.0
"""`calibrate_from_bag --estimate inertia`: the file gets it and keeps the rest, or is as it was."""

import json
from pathlib import Path

import numpy as np
import pytest
from galen_calibration_behavior.calibrate_from_bag import main
from galen_common.command import EXIT_FAILED, EXIT_USAGE
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.inertia import point_mass_inertia
from galen_model.load.model import ADAPTER, TOOLS

BAGS = Path(__file__).resolve().parents[2] / "bags"
OWN_KG_M2 = (2.3e-4, 5.3e-4, 4.4e-4, 0.0, -3e-5, 0.0)  # about the centres, as the bag was made
TRUE = point_mass_inertia(TOOLS["retractor"].load, ADAPTER) + OWN_KG_M2


@pytest.fixture
def file(tmp_path):
    """The retractor's, without an inertia."""
    path = tmp_path / "retractor.json"
    write_calibration(path, read_calibration(BAGS / "tools/retractor.json", arm=GALEN))
    return path


def run(capsys, tool, bag, file, *arguments):
    options = ("--tools-dir", str(file.parent), "--estimate", "inertia")
    try:
        code = main([tool, str(bag), *options, *arguments])
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_file_gets_the_inertia_and_keeps_the_rest(file, capsys):
    before = json.loads(file.read_text())
    code, out, _ = run(capsys, "retractor", BAGS / "swings", file, "--json")
    found = json.loads(out)
    assert code == 0 and found["agrees_with_file"] and found["blocks_left_out"] == 0
    estimate = read_calibration(file, arm=GALEN).inertia
    assert np.all(np.abs(estimate.about_sensor_kg_m2 - TRUE) < 4.5 * estimate.std_kg_m2)
    after = json.loads(file.read_text())
    assert after.pop("inertia") and after == before


def test_what_is_not_told_or_not_there_is_one_line_and_nothing_is_written(file, capsys):
    before = file.read_bytes()
    for tool, bag, message in (
        ("retractor", "retractor_calibration", "blocks of 0.5 s disagree with the rest"),
        ("pointer", "swings", "pointer.json: can't be read"),
        ("retractor", "no_bag", "no_bag"),
    ):
        code, out, err = run(capsys, tool, BAGS / bag, file)
        assert (code, out) == (EXIT_FAILED, "")
        assert message in err and err.count("\n") == 1
    assert run(capsys, "../x", BAGS / "swings", file)[0] == EXIT_USAGE
    assert file.read_bytes() == before
