# SPDX-License-Identifier: Apache-2.0
"""Parameters as a command's options."""

import argparse
from dataclasses import dataclass

import pytest
from galen_common.command import make_parser
from galen_common.parameters import add_options, from_options, param


@dataclass(frozen=True)
class Example:
    average_s: float = param(0.5, "length of the average, 100 % of it", 0.01, 60.0)
    min_samples: int = param(20, "fewest samples", minimum=4)
    tools_dir: str = param("~/tools", "where the tools' files are")
    other: float = param(1.0, "not an option")


NAMES = ("average_s", "min_samples", "tools_dir")


def parse(*arguments):
    parser = argparse.ArgumentParser(prog="example")
    add_options(parser, Example, NAMES)
    return from_options(parser.parse_args(arguments), Example, NAMES)


def test_defaults_and_values_are_the_parameters():
    assert parse() == Example()
    given = parse("--average-s", "2", "--min-samples", "5", "--tools-dir", "x")
    assert given == Example(average_s=2.0, min_samples=5, tools_dir="x")
    assert isinstance(given.average_s, float)


@pytest.mark.parametrize(
    "arguments",
    [("--average-s", "0"), ("--average-s", "nan"), ("--average-s", "long"),
     ("--min-samples", "3"), ("--min-samples", "4.5"), ("--other", "2")],
)  # fmt: skip
def test_what_the_node_would_reject_is_a_usage_error(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        parse(*arguments)
    assert end.value.code == 2
    assert arguments[0] in capsys.readouterr().err


def test_the_error_of_arguments_that_an_option_took_names_the_remedy(capsys):
    parser = make_parser("example", "")
    parser.add_argument("inputs", nargs="+")
    parser.add_argument("--reference", nargs="+")
    with pytest.raises(SystemExit):
        parser.parse_args(["--reference", "earlier", "later"])
    assert "required: inputs (arguments without an option go first, or after --)" in (
        capsys.readouterr().err
    )
    assert parser.parse_args(["--reference", "earlier", "--", "later"]).inputs == ["later"]
