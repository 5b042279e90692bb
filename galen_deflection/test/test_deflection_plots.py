"""The pictures hold what they should; how they look was looked at."""

import matplotlib.image
import numpy as np
import pytest
from deflection_pushes import hysteretic, make_samples, predict
from galen_deflection.measurement.pushes import tip_wrench
from galen_deflection.scoring.plots import (
    plot_axis,
    plot_course,
    plot_training,
    plot_true_over_predicted,
)

RED, BLUE = 0xC44E52, 0x1F6F8B


def colours_in(path):
    """Colours (as numbers) and pixels of a picture."""
    pixels = np.round(255.0 * matplotlib.image.imread(path)[:, :, :3]).astype(np.int64)
    return set(np.unique(pixels @ [1 << 16, 1 << 8, 1]).tolist()), pixels.shape


def two_positions():
    samples, predicted = hysteretic()
    halves = np.repeat([0, 1], [531, 531])
    samples = make_samples(tip_wrench(samples), samples.deflection, segment=halves, position=halves)
    predicted.extrapolated[531:] = True
    return samples, predicted


def test_courses_show_every_model_and_only_the_axes_asked_for(tmp_path):
    samples, predicted = two_positions()
    models = {"half": predicted, "none": predict(np.zeros((1062, 6)))}
    path = plot_course(samples, models, tmp_path / "new" / "course.png", "all")
    found, high = colours_in(path)
    assert {RED, BLUE} <= found
    found, low = colours_in(plot_course(samples, {"half": predicted}, path, axes=[1]))
    assert RED in found
    assert BLUE not in found
    assert low[0] < 0.6 * high[0]


def test_one_axis_shows_every_model(tmp_path):
    samples, predicted = two_positions()
    models = {"half": predicted, "none": predict(np.zeros((1062, 6)))}
    found, _ = colours_in(plot_axis(samples, models, tmp_path / "axis.png", axis=1))
    assert {RED, BLUE} <= found


def test_true_over_predicted_tells_positions_apart(tmp_path):
    samples, predicted = two_positions()
    found, _ = colours_in(plot_true_over_predicted(samples, predicted, tmp_path / "over.png"))
    assert {RED, BLUE} <= found


def test_a_training_is_drawn_or_rejected(tmp_path):
    path = plot_training([3.0, 2.0, 1.5], [3.0, 2.5, 2.6], tmp_path / "training.png", best=1)
    found, _ = colours_in(path)
    assert {RED, BLUE} <= found
    for losses in ([1.0], []):
        with pytest.raises(ValueError, match=f"{len(losses)} of checking"):
            plot_training([1.0, 2.0][: 2 * len(losses)], losses, tmp_path / "bad.png")
    assert not (tmp_path / "bad.png").exists()
