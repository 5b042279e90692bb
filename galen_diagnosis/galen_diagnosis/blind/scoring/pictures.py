"""The blind check's pictures: confusions, how probabilities hold, errors in the program's own σ."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.axes import Axes
from scipy.stats import norm

from galen_diagnosis.blind.scoring.rates import Calibration
from galen_diagnosis.blind.scoring.score import Score

_BLUE, _GREY, _RED = "#1f6f8b", "#8c8c8c", "#c44e52"
_FAR_SIGMA = 6.0


def draw_pictures(score: Score, folder: Path) -> list[Path]:
    """Write what there is to draw; returns the files. Raises OSError."""
    written = [_confusion(score, folder / "confusion.png")]
    if score.calibration is not None:
        written.append(_reliability(score.calibration, folder / "reliability.png"))
    if any(error.in_sigma is not None for error in score.errors):
        written.append(_errors(score, folder / "parameter_errors.png"))
    return written


def _confusion(score: Score, path: Path) -> Path:
    figure, panels = plt.subplots(1, 2, figsize=(17, 8.6), sharey=True, layout="constrained")
    rows = np.flatnonzero(score.confusion.sum(axis=1))
    size = np.maximum(score.confusion.sum(axis=1, keepdims=True), 1)[rows]
    for panel, values, title in (
        (panels[0], score.confusion[rows] / size, "the ranking's first, share of the recordings"),
        (panels[1], score.predicted[rows] / size, "the mean of the probabilities"),
    ):
        _matrix(panel, values)
        panel.set_xticks(range(len(score.names)), score.names, rotation=90)
        panel.set_title(title)
        panel.set_xlabel("answer")
    labels = [f"{score.names[row]} ({int(score.confusion[row].sum())})" for row in rows]
    panels[0].set_yticks(range(len(rows)), labels)
    panels[0].set_ylabel("truth (recordings)")
    figure.suptitle("Blind check: what was taken for what; none, single effects, unknown")
    return save_figure(figure, path)


def _matrix(panel: Axes, values: Array) -> None:
    panel.imshow(values, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        if value >= 0.05:
            panel.text(
                column, row, f"{100 * value:.0f}", ha="center", va="center", fontsize=7,
                color="white" if value > 0.6 else "black",
            )  # fmt: skip


def _reliability(found: Calibration, path: Path) -> Path:
    figure, panel = plt.subplots(figsize=(6.4, 6.0), layout="constrained")
    some = found.count > 0
    panel.plot([0, 1], [0, 1], color=_GREY, lw=1, ls="--", label="probabilities that hold")
    probability, right, count = found.probability[some], found.right[some], found.count[some]
    spread = 1.96 * np.sqrt(probability * (1.0 - probability) / count)
    panel.errorbar(
        probability, right, yerr=spread, fmt="o", color=_BLUE, capsize=3,
        label="ranking's first; bars: 95 % by chance",
    )  # fmt: skip
    for p, r, c in zip(probability, right, count, strict=True):
        panel.annotate(str(int(c)), (p, r), xytext=(7, -10), textcoords="offset points", fontsize=8)
    panel.set(
        xlim=(-0.02, 1.05), ylim=(-0.05, 1.1),
        xlabel="mean probability of the first", ylabel="share that is right",
        title=f"Probabilities of {found.n} answers: calibration error {found.error:.3f},"
        f" by chance {found.by_chance:.3f}",
    )  # fmt: skip
    panel.legend(loc="upper left")
    return save_figure(figure, path)


def _errors(score: Score, path: Path) -> Path:
    told = [(e.effect, e.in_sigma) for e in score.errors if e.in_sigma is not None]
    effects = [name for name in score.names if any(name == effect for effect, _ in told)]
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(14, 1.8 + 0.32 * len(effects) + 1.5), width_ratios=(1.6, 1.0),
        layout="constrained",
    )  # fmt: skip
    for row, effect in enumerate(effects):
        own = np.array([sigma for name, sigma in told if name == effect])
        shown = np.clip(own, -_FAR_SIGMA, _FAR_SIGMA)
        far = np.abs(own) > _FAR_SIGMA
        left.plot(shown[~far], np.full((~far).sum(), row), "o", color=_BLUE, ms=4, alpha=0.7)
        left.plot(shown[far], np.full(far.sum(), row), "x", color=_RED, ms=6)
    left.axvspan(-1.96, 1.96, color=_GREY, alpha=0.2, lw=0)
    left.set_yticks(range(len(effects)), effects)
    left.set_xlabel(f"error in own σ (band: 95 %; crosses lie beyond ±{_FAR_SIGMA:.0f})")
    left.invert_yaxis()
    values = np.clip([sigma for _, sigma in told], -_FAR_SIGMA, _FAR_SIGMA)
    bins = np.linspace(-_FAR_SIGMA, _FAR_SIGMA, 25)
    right.hist(values, bins=bins, density=True, color=_BLUE, alpha=0.7)
    at = np.linspace(-_FAR_SIGMA, _FAR_SIGMA, 200)
    right.plot(at, norm.pdf(at), color=_GREY, lw=2, label="as it should be")
    right.set_xlabel("error in own σ")
    right.legend()
    covered = score.covered.value
    share = "" if covered is None else f": {100 * covered:.0f} % within their 95 % interval"
    figure.suptitle(f"{len(told)} parameters{share}")
    return save_figure(figure, path)
