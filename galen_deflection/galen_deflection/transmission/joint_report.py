"""A joint's comparison for a person, and for a program; several of them in one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from galen_model.errors import GalenError
from galen_model.files.json_fields import (
    FieldError,
    check_version,
    get,
    mapping,
    number,
    read_json,
)
from galen_model.transmission.joint_run import swapped
from rich.console import Console
from rich.table import Table

from galen_deflection.transmission import joint_parameters
from galen_deflection.transmission.comparison import Comparison
from galen_deflection.transmission.joint_parameters import MEANINGS, UNITS, JointParameters

SCHEMA_VERSION = 1
MRAD = 1e3
"""Lags are printed in mrad."""

_MOST_BYTES = 10_000_000
_TIED = 1.0 + 1e-6


class ReportError(GalenError):
    """A comparison that can't be read back; the message names the file and the field."""


def to_dict(comparison: Comparison, parameters: JointParameters, label: str) -> dict[str, Any]:
    """For JSON: SI units, no NaN."""
    parts, noise = comparison.parts, comparison.noise
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
        "common_terms": list(comparison.settings.common),
        "lag_std_rad": comparison.lag_std,
        "noise_rad": {
            "motor_step": noise.motor_step,
            "link_step": noise.link_step,
            "quantisation": noise.quantisation,
            "jitter": noise.jitter,
            "floor": noise.floor,
        },
        "scores": {
            name: {
                "rmse_rad": score.rmse,
                "rmse_ci95_rad": list(score.interval),
                "share_of_std": score.share,
                "by_part_rad": dict(zip(parts.names, score.by_part.tolist(), strict=True)),
                "seconds": score.seconds,
            }
            for name, score in comparison.scores.items()
        },
        "ours_by_part": dict(zip(parts.names, comparison.chosen, strict=True)),
        "ours_over_network": None
        if comparison.against is None
        else {
            "network": comparison.against[0],
            "ratio": comparison.against[1],
            "ci95": list(comparison.against[2]),
        },
        "parameters": joint_parameters.to_json(parameters),
        "notes": notes(comparison, parameters),
    }


def notes(comparison: Comparison, parameters: JointParameters) -> list[str]:
    """What a user should know before believing it; sentences."""
    found = []
    plain = parameters.plain["compliance"]
    if plain.interval[1] < 0.0:
        found.append(
            "a plain fit says that the lag falls as the torque grows: if the torque is the "
            "reaction's, a negative --torque-gear turns it; if not, the lag is not a spring's"
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


def print_comparison(
    comparison: Comparison, parameters: JointParameters, label: str, console: Console
) -> None:
    """The table of models, then how the joint gives."""
    console.print(_score_table(comparison, label))
    console.print(_parameter_table(parameters))
    for note in notes(comparison, parameters):
        console.print(f"[yellow]{note}[/yellow]", soft_wrap=True)


def _score_table(comparison: Comparison, label: str) -> Table:
    scale, parts = MRAD, comparison.parts
    table = Table(title=f"{label}: lag that no model has seen, mrad", title_justify="left")
    table.add_column("model")
    for heading in ("RMSE", "95 %", "of the lag's std", "best part", "worst part", "time, s"):
        table.add_column(heading, justify="right")
    least = min(score.rmse for score in comparison.scores.values())
    for name, score in comparison.scores.items():
        best = "[green]" if score.rmse <= _TIED * least else ""
        low, high = (scale * bound for bound in score.interval)
        table.add_row(
            name,
            f"{best}{scale * score.rmse:.3f}",
            f"{low:.3f} - {high:.3f}",
            f"{100.0 * score.share:.1f} %",
            f"{scale * score.by_part.min():.3f}",
            f"{scale * score.by_part.max():.3f}",
            "" if score.seconds is None else f"{score.seconds:.1f}",
        )
    noise = comparison.noise
    steps = (
        f"steps of the encoders {scale * noise.motor_step:.3f} and {scale * noise.link_step:.3f}"
        if noise.motor_step or noise.link_step
        else "no steps of the encoders to be seen"
    )
    lines = [
        f"{len(parts.names)} parts held out in turn; the lag's std {scale * comparison.lag_std:.3f}"
        f", its noise {scale * noise.floor:.3f} ({steps})",
        "all see torque, motor's angle and velocity, up to now; "
        f"terms in all but the constant: {', '.join(comparison.settings.common) or 'none'}",
        f"ours: {_counted(comparison.chosen)}",
    ]
    if comparison.against is not None:
        network, ratio, (low, high) = comparison.against
        lines.append(
            f"ours over {network}: {ratio:.2f} ({low:.2f} - {high:.2f}), {_verdict(low, high)}"
        )
    table.caption = "\n".join(lines)
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
    stiffness = parameters.stiffness
    rows = [
        (name, MEANINGS[name], found, 1.0, UNITS[name])
        if UNITS[name] != "rad"
        else (name, MEANINGS[name], found, MRAD, "mrad")
        for name, found in parameters.estimates.items()
        if found.value != 0.0
    ]
    if stiffness is not None:
        rows.insert(0, ("stiffness", "1 / compliance", stiffness, 1.0, "N.m/rad"))
    for name, meaning, found, scale, in_unit in rows:
        low, high = (scale * bound for bound in found.interval)
        table.add_row(
            name.replace("_", " "), meaning, f"{scale * found.value:.4g}",
            f"{scale * found.std:.2g}", f"{low:.4g} - {high:.4g}", in_unit,
        )  # fmt: skip
    give, direction = parameters.plain["compliance"], parameters.plain["direction"]
    scale = MRAD
    table.caption = (
        "plain least squares of a spring and the direction: "
        f"{scale * give.value:.4g} +- {scale * give.std:.2g} mrad/(N.m) and "
        f"{scale * direction.value:+.4g} +- {scale * direction.std:.2g} mrad"
    )
    table.caption_justify = "left"
    return table


def _counted(names: Sequence[str]) -> str:
    return ", ".join(f"{name} ({names.count(name)})" for name in sorted(set(names)))


def _verdict(low: float, high: float) -> str:
    if high < 1.0:
        return "ours wins"
    return "ours does not win" if low <= 1.0 else "ours loses"


# --- several -------------------------------------------------------------------------------------


class Listed(NamedTuple):
    """One comparison that was read back: RMSE (rad) and its share of the lag's std, by model."""

    label: str
    scores: dict[str, tuple[float, float]]
    noise: float
    lag_std: float


def read_listed(file: Path) -> Listed:
    """From what `--json` printed; raises ReportError."""
    try:
        content = mapping(read_json(file, _MOST_BYTES, "a comparison of `evaluate`"), "it")
        check_version(content, SCHEMA_VERSION)
        scores = {
            str(name): (
                number(get(mapping(row, f"scores.{name}"), "rmse_rad"), f"{name}.rmse_rad"),
                number(get(mapping(row, f"scores.{name}"), "share_of_std"), f"{name}.share_of_std"),
            )
            for name, row in mapping(get(content, "scores"), "scores").items()
        }
        noise = mapping(get(content, "noise_rad"), "noise_rad")
        return Listed(
            file.stem,
            scores,
            number(get(noise, "floor"), "noise_rad.floor"),
            number(get(content, "lag_std_rad"), "lag_std_rad"),
        )
    except OSError as error:
        raise ReportError(f"{file}: can't be read: {error.strerror}") from error
    except FieldError as error:
        raise ReportError(f"{file}: {error}") from error


def joint_table(listed: Sequence[Listed]) -> Table:
    """A model a row, a comparison a column: RMSE and its share of the lag's standard deviation."""
    table = Table(title="lag that no model has seen, mrad", title_justify="left")
    table.add_column("model")
    for one in listed:
        table.add_column(one.label, justify="right")
    names = list(dict.fromkeys(name for one in sorted(listed, key=_size) for name in one.scores))
    for name in names:
        table.add_row(name, *(_cell(one, name) for one in listed))
    table.add_section()
    scale = MRAD
    table.add_row("the lag's std", *(f"{scale * one.lag_std:.3f}" for one in listed))
    table.add_row("noise", *(f"{scale * one.noise:.3f}" for one in listed))
    return table


def to_rows(listed: Sequence[Listed]) -> list[Mapping[str, Any]]:
    """For JSON."""
    return [
        {
            "label": one.label,
            "noise_rad": one.noise,
            "lag_std_rad": one.lag_std,
            "scores": {
                name: {"rmse_rad": rmse, "share_of_std": share}
                for name, (rmse, share) in one.scores.items()
            },
        }
        for one in listed
    ]


def _size(one: Listed) -> int:
    return -len(one.scores)


def _cell(one: Listed, name: str) -> str:
    if name not in one.scores:
        return "-"
    rmse, share = one.scores[name]
    best = rmse <= _TIED * min(other for other, _ in one.scores.values())
    shown = f"{MRAD * rmse:.3f} ({100.0 * share:.0f} %)"
    return f"[green]{shown}[/green]" if best else shown
