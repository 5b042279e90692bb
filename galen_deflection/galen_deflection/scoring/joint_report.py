# SPDX-License-Identifier: Apache-2.0
"""`evaluate` of tables: how a single joint deflects, models side by side on held-out readings."""

from __future__ import annotations

import argparse
from typing import Any

from galen_bags.arrays.joint_table import add_column_options, joint_columns, read_joint_runs
from galen_common.command import EXIT_OK, print_json, progress, terminal, whole
from galen_model.transmission import COMMON, swapped, time_blocks, whole_runs
from rich.table import Table

from galen_deflection.scoring.joint_fit import (
    UNITS,
    Comparison,
    Estimate,
    JointParameters,
    compare,
    estimate,
)
from galen_deflection.scoring.report import TABLE_WIDTH

SCHEMA_VERSION = 1

MODELS = """models of a joint, each checked on readings that it was not fitted to:
  constant, common terms   baselines: rigid
  linear                   a spring
  direction                and the motor's direction of motion
  torque plays             a spring with friction (Prandtl-Ishlinskii, of the torque)
  lost motion              a spring, and plays of the motor's motion (backlash)
  both plays
  ours                     of these, what hold-outs among the fitted readings choose"""

MEANINGS = {
    "compliance_first": "just after the torque turns back",
    "compliance": "once everything slides",
    "direction": "lag + or - this, by the motor's direction",
    "torque_loop": "widest loop at one torque",
    "lost_motion": "lost when the motor turns back",
    "gear_error": "lag that grows with the motor's angle",
    "delay": "lag that grows with the motor's velocity",
    "offset": "lag amid the motor's range, without torque",
}

_MRAD = 1e3
_BLOCKS = 6
_FEWEST_RUNS = 3
_TIED = 1.0 + 1e-6


def add_joint_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for tables of a joint's readings.

    Args:
        parser: the parser of `evaluate`.

    """
    add_column_options(parser.add_argument_group("tables of a joint: columns"))
    group = parser.add_argument_group("tables of a joint: models and hold-outs")
    group.add_argument(
        "--terms",
        type=_terms,
        metavar="NAMES",
        help="in all models but the constant: gear (lag grows with the motor's angle), delay (with"
        " its velocity); comma-separated (default: none)",
    )
    group.add_argument(
        "--unlike",
        metavar="REGEX",
        help="fit only to runs whose file's name differs from the checked one's in every group of"
        " this regular expression",
    )
    group.add_argument(
        "--blocks",
        type=whole(3),
        metavar="N",
        help=f"hold out N blocks of time of all runs (default: whole runs where there are three,"
        f" else {_BLOCKS} blocks)",
    )


def evaluate_tables(arguments: argparse.Namespace) -> int:
    """Fit and compare models of one joint.

    Args:
        arguments: options of `add_joint_options`, with `inputs` and `json`.

    Returns:
        The exit code.

    Raises:
        GalenError: a table can't be used, there are too few runs or readings, or nothing to fit to.

    """
    runs = read_joint_runs(arguments.inputs, joint_columns(arguments))
    by_run = arguments.unlike is not None or len(runs) >= _FEWEST_RUNS
    if by_run and arguments.blocks is None:
        parts = whole_runs(runs, arguments.unlike)
    else:
        parts = time_blocks(runs, arguments.blocks or _BLOCKS)
    with progress(len(parts.names), "part", quiet=arguments.json) as bar:
        comparison = compare(runs, parts, arguments.terms or (), bar.update)
    label = arguments.inputs[0].stem
    parameters = estimate(comparison)
    if arguments.json:
        print_json(to_json(comparison, parameters, label))
        return EXIT_OK
    to = terminal(TABLE_WIDTH)
    to.print(_score_table(comparison, label))
    to.print(_parameter_table(parameters))
    for note in notes(comparison, parameters):
        to.print(f"[yellow]{note}[/yellow]", soft_wrap=True)
    return EXIT_OK


def to_json(comparison: Comparison, parameters: JointParameters, label: str) -> dict[str, Any]:
    """Return plain numbers, SI units, no NaN.

    Args:
        comparison: the models' scores on what they have not seen.
        parameters: of the form fitted to all readings.
        label: name of the joint.

    Returns:
        Content for JSON.

    """

    def row(found: Estimate, unit: str) -> dict[str, Any]:
        interval = list(found.interval)
        return {"value": found.value, "std": found.std, "ci95": interval, "unit": unit}

    parts, noise, stiffness = comparison.parts, comparison.noise, parameters.stiffness
    return {
        "schema_version": SCHEMA_VERSION,
        "label": label,
        "runs": [
            {"name": run.name, "readings": len(run), "rate_hz": 1.0 / run.step_s}
            for run in comparison.runs
        ],
        "held_out": {
            name: [parts.names[k] for k in parts.trained_on(part)]
            for part, name in enumerate(parts.names)
        },
        "common_terms": list(comparison.common),
        "lag_std_rad": comparison.lag_std,
        "noise_rad": noise._asdict() | {"floor": noise.floor},
        "scores": {
            name: {
                "rmse_rad": score.rmse,
                "rmse_ci95_rad": list(score.interval),
                "share_of_std": score.share,
                "by_part_rad": dict(zip(parts.names, score.by_part.tolist(), strict=True)),
            }
            for name, score in comparison.scores.items()
        },
        "ours_by_part": dict(zip(parts.names, comparison.chosen, strict=True)),
        "parameters": {
            "form": parameters.form,
            "stiffness": None if stiffness is None else row(stiffness, "N.m/rad"),
            "estimates": {
                name: row(one, UNITS[name]) for name, one in parameters.estimates.items()
            },
            "plain_least_squares": {
                name: row(one, UNITS[name]) for name, one in parameters.plain.items()
            },
        },
        "notes": notes(comparison, parameters),
    }


def notes(comparison: Comparison, parameters: JointParameters) -> list[str]:
    """Return what a user should know before relying on it.

    Args:
        comparison: the joint's runs.
        parameters: of the form fitted to all readings.

    Returns:
        Sentences, none where all is well.

    """
    found = []
    if parameters.plain["compliance"].interval[1] < 0.0:
        found.append(
            "by a plain fit the lag falls as the torque grows: if the torque is the reaction's, a "
            "negative --torque-gear turns it; if not, the lag is not a spring's"
        )
    if swapped(comparison.runs):
        found.append("the link turns back before the motor does: are motor and link swapped?")
    delay = parameters.plain.get("delay")
    if delay is not None and (delay.interval[0] > 0.0 or delay.interval[1] < 0.0):
        step = min(run.step_s for run in comparison.runs)
        found.append(
            f"the link's readings come {1e3 * delay.value:.2f} +- {1e3 * delay.std:.2f} ms after "
            f"the motor's ({delay.value / step:.2f} of a reading), or something damps: "
            "without the term, a spring and the direction have to make up for it"
        )
    return found


def _score_table(comparison: Comparison, label: str) -> Table:
    table = Table(title=f"{label}: lag that no model has seen, mrad", title_justify="left")
    table.add_column("model")
    for heading in ("RMSE", "95 %", "of the lag's std", "best part", "worst part"):
        table.add_column(heading, justify="right")
    least = min(score.rmse for score in comparison.scores.values())
    for name, score in comparison.scores.items():
        best = "[green]" if score.rmse <= _TIED * least else ""
        low, high = (_MRAD * bound for bound in score.interval)
        table.add_row(
            name,
            f"{best}{_MRAD * score.rmse:.3f}",
            f"{low:.3f} - {high:.3f}",
            f"{100.0 * score.share:.1f} %",
            f"{_MRAD * score.by_part.min():.3f}",
            f"{_MRAD * score.by_part.max():.3f}",
        )
    noise, chosen = comparison.noise, comparison.chosen
    counted = ", ".join(f"{name} ({chosen.count(name)})" for name in sorted(set(chosen)))
    table.caption = (
        f"{len(comparison.parts.names)} parts held out in turn; the lag's std"
        f" {_MRAD * comparison.lag_std:.3f}, its noise {_MRAD * noise.floor:.3f} (steps of the"
        f" encoders {_MRAD * noise.motor_step:.3f} and {_MRAD * noise.link_step:.3f})\n"
        "all see torque, motor's angle and velocity, up to now; terms in all but the constant:"
        f" {', '.join(comparison.common) or 'none'}\nours: {counted}"
    )
    table.caption_justify = "left"
    return table


def _parameter_table(parameters: JointParameters) -> Table:
    table = Table(
        title=f"how it deflects: {parameters.form}, fitted to everything", title_justify="left"
    )
    table.add_column("")
    table.add_column("")
    for heading in ("value", "std", "95 %"):
        table.add_column(heading, justify="right")
    table.add_column("unit")
    rows = [
        (name, MEANINGS[name], found, UNITS[name])
        for name, found in parameters.estimates.items()
        if found.value != 0.0
    ]
    if parameters.stiffness is not None:
        rows.insert(0, ("stiffness", "1 / compliance", parameters.stiffness, "N.m/rad"))
    for name, meaning, found, unit in rows:
        scale, unit = (_MRAD, "mrad") if unit == "rad" else (1.0, unit)
        low, high = (scale * bound for bound in found.interval)
        table.add_row(
            name.replace("_", " "), meaning, f"{scale * found.value:.4g}",
            f"{scale * found.std:.2g}", f"{low:.4g} - {high:.4g}", unit,
        )  # fmt: skip
    compliance, direction = parameters.plain["compliance"], parameters.plain["direction"]
    table.caption = (
        "plain least squares of a spring and the direction: "
        f"{_MRAD * compliance.value:.4g} +- {_MRAD * compliance.std:.2g} mrad/(N.m) and "
        f"{_MRAD * direction.value:+.4g} +- {_MRAD * direction.std:.2g} mrad"
    )
    table.caption_justify = "left"
    return table


def _terms(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in COMMON:
            raise argparse.ArgumentTypeError(f"{name!r}: expected {' or '.join(COMMON)}")
    return tuple(name for name in COMMON if name in names)
