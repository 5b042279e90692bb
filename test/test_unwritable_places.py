# SPDX-License-Identifier: Apache-2.0
"""Commands whose output can't be written say so before their work, not after it."""

import importlib

import pytest

NOWHERE = "/proc/galen/new"  # for root, too
COMMANDS = {
    "galen_bags.convert": ("IN.csv", "-o", NOWHERE),
    "galen_deflection.evaluate": ("IN", "--tool", "IN", "--model", "IN", "--plots", NOWHERE),
    "galen_deflection.train": ("IN", "--tool", "IN", "--kind", "joint_stiffness", "-o", NOWHERE),
    "galen_diagnosis.diagnose": ("IN", "--output", NOWHERE),
    "galen_diagnosis.diagnose --next": ("IN", "--next", NOWHERE),
    "galen_diagnosis.diagnose many": ("IN", "IN2", "--output", NOWHERE),
    "galen_diagnosis.diagnose table": ("pyproject.toml", "--output", NOWHERE),
    "galen_diagnosis.simulated_recording": ("tilt", "--output", NOWHERE),
    "galen_gravcomp.evaluate.command --drift": ("IN", "--drift", "--plots", NOWHERE),
    "galen_gravcomp.evaluate.command": (
        "bags",
        "--tool",
        "bags/tools/pointer.json",
        "--plots",
        NOWHERE,
    ),
    "galen_gravcomp.evaluate.command --write-bags": (
        "bags",
        "--tool",
        "bags/tools/pointer.json",
        "--write-bags",
        NOWHERE,
    ),
    "galen_gravcomp.evaluate.command table": ("IN.csv", "--plots", NOWHERE),
    "galen_gravcomp.evaluate.command --write-tool": (
        "IN.csv",
        "--write-tool",
        f"{NOWHERE}/t.json",
    ),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unwritable_place_is_said_before_the_work(command, monkeypatch, capsys, pytestconfig):
    monkeypatch.chdir(pytestconfig.rootpath)
    main = importlib.import_module(command.split()[0]).main
    try:
        code = main(list(COMMANDS[command]))
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    # IN isn't there: a command that came to read it would say that instead.
    assert (code, out, err.count("\n")) == (1, "", 1), err
    assert f"{NOWHERE}" in err and "can't be" in err
