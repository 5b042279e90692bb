"""Tables of a drift recording for a person."""

from __future__ import annotations

from galen_model.arm.galen import WRENCH_AXES
from rich.console import Console
from rich.table import Table

from galen_gravcomp.evaluate.drift.result import GROUPS, DriftResult, duration_text


def print_drift(result: DriftResult, console: Console) -> None:
    """The answer, then what it stands on. Forces in N, torques in mN.m."""
    series = result.series
    for sentence in result.sentence.values():
        console.print(f"[bold]{sentence}[/bold]", soft_wrap=True)
    console.print(f"\n{duration_text(series.duration_s)}, {series.samples} readings")
    if series.touched_s:
        total = sum(end - begin for begin, end in series.touched_s)
        first = ", ".join(f"{begin:.0f}-{end:.0f} s" for begin, end in series.touched_s[:3])
        more = ", ..." if len(series.touched_s) > 3 else ""
        console.print(
            f"[yellow]left out as touched: {len(series.touched_s)} spans, {total:.0f} s in all"
            f" ({first}{more})[/yellow]"
        )
    for at, change in series.steps:
        console.print(
            f"[yellow]the level jumps at {at:.0f} s and stays: force"
            f" {', '.join(f'{v:+.3f}' for v in change[:3])} N[/yellow]"
        )
    for note in series.notes:
        console.print(f"[yellow]{note}[/yellow]")
    table = Table(title="What the reading is made of", title_justify="left")
    heads = ("", "one reading", "white, /sqrt(Hz)", "instability", "walk, /sqrt(h)", "line, /h")
    for head in heads:
        table.add_column(head, justify="right" if head else "left")
    for index, (axis, allan) in enumerate(zip(WRENCH_AXES, result.allan, strict=True)):
        factor, unit = (1.0, "N") if index < 3 else (1e3, "mN.m")
        values = (
            series.noise[index],
            allan.white,
            allan.instability,
            allan.walk * 60.0,
            result.rate_per_hour[index],
        )
        table.add_row(f"{axis} ({unit})", *(f"{value * factor:.4f}" for value in values))
    console.print(table)
    names = ("zero", "last", "level", "trend", "line", "ar", "day")
    table = Table(
        title="Forecasts on the second half: root mean square error (of three axes)",
        title_justify="left",
    )
    for head in ("ahead", *names, "skill (99 %)"):
        table.add_column(head, justify="right" if head != "ahead" else "left")
    for group in GROUPS:
        factor, unit = (1.0, "N") if group == "force" else (1e3, "mN.m")
        if result.scores[group]:
            table.add_row(f"[bold]{group} ({unit})[/bold]")
        for score in result.scores[group]:
            cells = [
                f"{score.rmse[name] * factor:.4f}" if name in score.rmse else "-" for name in names
            ]
            skill = f"{score.skill:+.2f} ({score.interval[0]:+.2f} ... {score.interval[1]:+.2f})"
            if score.predictable:
                skill = f"[green]{skill}[/green]"
            table.add_row(duration_text(score.horizon_s), *cells, skill)
    console.print(table)
    console.print(
        "zero: the value just after zeroing; last: the newest cell of"
        f" {result.forecast_cell_s:g} s; skill: of the better of trend, line, ar, day over that of"
        " zero, last, level, both chosen on the first half"
    )
