"""The table of what `benchmarks.node` measured, and its ratios to the bare relay."""

import statistics
from collections.abc import Sequence

from rich.table import Table

from benchmarks.node import Measurement


def ratios(found: Sequence[Measurement], subject: str, rate_hz: float, what: str) -> list[float]:
    """A subject's `what` over the relay's of the same round, for each round."""
    by_round = {
        (one.subject, one.round): getattr(one, what) for one in found if one.rate_hz == rate_hz
    }
    return [
        value / by_round["relay", number]
        for (name, number), value in by_round.items()
        if name == subject and ("relay", number) in by_round
    ]


def table(found: Sequence[Measurement]) -> Table:
    """A row a subject and rate: least/median/largest of the rounds."""
    out = Table(
        "subject", "Hz", "lost", "CPU us a wrench", "x relay", "p50 ms", "p99 ms", "x relay",
        "p99.9 ms", "largest ms", box=None, header_style="bold",
    )  # fmt: skip
    for column in out.columns[1:]:
        column.justify = "right"
    for rate_hz in dict.fromkeys(one.rate_hz for one in found):
        for subject in dict.fromkeys(one.subject for one in found):
            own = [one for one in found if (one.subject, one.rate_hz) == (subject, rate_hz)]
            lost, came = sum(one.lost for one in own), sum(one.received for one in own)

            def three(what: str, digits: int, own: list[Measurement] = own) -> str:
                return spread([getattr(one, what) for one in own], digits)

            out.add_row(
                subject, f"{rate_hz:g}", f"{lost} of {lost + came}",
                three("cpu_us_per_wrench", 0),
                spread(ratios(found, subject, rate_hz, "cpu_us_per_wrench"), 2),
                three("latency_p50_ms", 2), three("latency_p99_ms", 2),
                spread(ratios(found, subject, rate_hz, "latency_p99_ms"), 2),
                three("latency_p999_ms", 1), three("latency_max_ms", 1),
            )  # fmt: skip
        out.add_section()
    return out


def spread(values: Sequence[float], digits: int) -> str:
    """Least, median and largest; one value alone."""
    if not values:
        return ""
    shown = [f"{v:.{digits}f}" for v in (min(values), statistics.median(values), max(values))]
    return shown[0] if len(values) == 1 else "/".join(shown)
