# SPDX-License-Identifier: Apache-2.0
"""The page, the pictures, the sentence, what was excluded, the driver's file."""

import base64
import hashlib
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import yaml
from diagnosis_example import example_answer, example_diagnosis
from galen_diagnosis.answer.answer import NO_GAP, Answer, Excluded, FoundCause, Interval
from galen_diagnosis.inference.diagnosing import explore
from galen_diagnosis.inference.excluded import detection_strength, excluded_effects
from galen_diagnosis.inference.posterior import Scored, load_settings, posterior
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.report.pictures import answer_figure, gap_figure
from galen_diagnosis.report.report import effect_file, report
from galen_diagnosis.report.words import (
    cause_words,
    data_words,
    missed_words,
    next_steps,
    parameter_words,
    plain,
    probability_words,
    sentence,
    title,
)
from galen_diagnosis.simulated_recording import make_recording
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.effect import ConfigError
from galen_sim_driver.effects.joints import JointZeroOffset
from galen_sim_driver.effects.load import ToolMassError
from galen_sim_driver.effects.registry import EFFECTS, contract_parameters
from galen_sim_driver.parameters import EffectParameters, effects_of
from matplotlib import pyplot as plt

HOSTILE = "x\"><script>alert(1)</script><img src=http://evil.example/a.png onerror='alert(2)'>&lt;"
LOADING = {"src", "href", "srcset", "data", "action", "background", "poster", "style", "srcdoc"}


class Page(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.attributes, self.text, self.open = [], [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attributes]
        if tag not in ("meta", "img", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.text.append(text)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Files of the pictures' names; the page doesn't look into them."""
    folder = tmp_path_factory.mktemp("pictures")
    files = {name: folder / f"{name}.png" for name in ("answer", "gap")}
    for name, file in files.items():
        file.write_bytes(name.encode())
    return files


@pytest.fixture(scope="module")
def diagnosis():
    return example_diagnosis()


def hostile(answer):
    """Names and texts that come from a file, all of them hostile."""
    return replace(
        answer,
        recording=HOSTILE,
        sentence=HOSTILE,
        cannot_tell=(HOSTILE,),
        problems=(HOSTILE,),
        next_experiment={"separates": [HOSTILE], "do": HOSTILE},
        ranking=((HOSTILE, 0.5), *answer.ranking),
        causes=tuple(replace(one, parameters={HOSTILE: HOSTILE}) for one in answer.causes),
        gap={**answer.gap, "before": {"rms": {HOSTILE: 1.0}}},
        tested=(Excluded(HOSTILE, because=HOSTILE),),
        corrections=(HOSTILE,),
        data=((HOSTILE, HOSTILE),),
    )


def test_page_stands_alone_and_runs_nothing(diagnosis, pictures):
    html = report(hostile(diagnosis.answer), pictures)
    page = Page(html)
    assert not page.open
    allowed = {
        "html", "head", "meta", "title", "style", "body", "header", "main", "h1", "h2", "p",
        "figure", "figcaption", "img", "div", "table", "tr", "th", "td", "meter", "ul", "li",
        "details", "summary",
    }  # fmt: skip
    assert set(page.tags) <= allowed
    for tag, name, value in page.attributes:
        assert not name.startswith("on")
        if name in LOADING:
            assert tag == "img" and value.startswith("data:image/png;base64,")
    assert "".join(page.text).count(HOSTILE) >= 12  # shown as it is, not as what it pretends to be


def test_policy_lets_in_its_own_style_and_pictures_only(diagnosis, pictures):
    html = report(diagnosis.answer, pictures)
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    (style,) = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    rules = {rule.split()[0]: rule.split()[1:] for rule in policy.split(";")}
    assert rules["default-src"] == ["'none'"] and rules["img-src"] == ["data:"]
    assert rules["style-src"] == [f"'sha256-{digest}'"]
    assert "prefers-color-scheme: dark" in style and "url(" not in style and "@import" not in style
    shown = re.findall(r'src="data:image/png;base64,([^"]*)"', html)
    assert [base64.b64decode(one) for one in shown] == [
        pictures[name].read_bytes() for name in ("answer", "gap")
    ]


def test_page_leads_with_answer_picture_and_step_and_folds_the_rest(diagnosis, pictures):
    answer = replace(
        diagnosis.answer,
        tested=(Excluded("joint_zero_offset:roll", {"offset_rad": 0.00138}),),
        corrections=("arm.urdf: the description with the right zero",),
        data=(("program", "galen_diagnosis 1.2"),),
    )
    top, *folds = report(answer, pictures).split("<details")
    first = " ".join("".join(Page(top).text).split())
    led = (answer.sentence, "What to do next", "Set the tilt joint's zero", "arm.urdf: the descr")
    places = [first.index(words) for words in led]
    assert places == sorted(places) and top.count("<img") == 1
    told = [
        ("What was found, number by number", "0.584° (0.567 to 0.602)", "93.0%"),
        ("What was tested and excluded", "zero of the roll joint", "0.079° (1.38 mrad)"),
        ("Where the residual lies", "sweep", "p: how often noise"),
        ("How far the gap closes on unseen data", "4.159", "98% (97% to 99%)", "ASME V&V 20"),
        ("Alternatives and their probabilities", "something that is not on the list"),
        ("What this recording can't show", "without a tracker a tilt's zero looks like"),
        ("Data", "galen_diagnosis 1.2", "sweep: 3 stamps went back"),
    ]
    for fold, words in zip(folds, told, strict=True):
        html = "<details" + fold.partition("</details>")[0]
        section = " ".join("".join(Page(html).text).split())
        assert section.startswith(words[0]) and [one for one in words if one not in section] == []


@pytest.fixture
def drawn():
    """Close what a test draws."""
    yield
    plt.close("all")


def test_answers_picture_shows_where_what_was_found_is_clearest(diagnosis, drawn):
    figure = answer_figure(diagnosis)
    # The example's residual is a sine in the first channel of each.
    titles = {axis.get_title("left") for axis in figure.axes}
    assert titles == {"motion: force, fx", "push: tip translation, dx"}
    named = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    added = named["what was found adds to nominal"]
    left = named["residual with it"]
    assert added + left == pytest.approx(named["measured less nominal"], nan_ok=True)
    assert abs(added).max() > 10.0 * abs(left).max()
    unknown = answer_figure(example_diagnosis("unknown"))
    assert all(len(axis.lines) == 1 for axis in unknown.axes)  # nothing was found


def test_gap_picture_has_one_scale_and_frames_what_is_beyond_noise(diagnosis, drawn):
    before, after = gap_figure(diagnosis).axes[:2]
    assert before.images[0].get_clim() == after.images[0].get_clim()
    # fx, fz and ty, in the sweep's, both of motion's and the pushes' rest
    assert len(before.patches) == 12 and len(after.patches) == 0
    assert "2.47" in before.get_title() and "1.00" in after.get_title()


def with_intervals(value):
    """A parameter as the contract has it, each number with an interval of its own."""
    if isinstance(value, dict):
        return {name: with_intervals(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [with_intervals(part) for part in value]
    return value if isinstance(value, str) else Interval(0.03, 0.0297, 0.0303)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_a_sentence_with_all_its_numbers(name):
    effect = EFFECTS[name]()
    told = contract_parameters(effect.with_vector(effect.vector() + 0.03))
    parameters = {key: with_intervals(value) for key, value in told.items() if key != "joint"}
    cause = FoundCause(name, 1.0, parameters, (), None, joint="tilt")
    text = cause_words(cause)
    assert not text.startswith(title(cause.label) + " (")  # its name if its words don't fit
    for parameter in parameters:
        assert parameter_words(parameter, parameters) in text, parameter
    assert cause_words(replace(cause, parameters={})).strip()  # an unknown number is no error


@pytest.mark.parametrize(
    ("effect", "parameters", "expected"),
    [
        (
            "sensor_saturation",
            {"axis": "ty", "limit": Interval(0.05, None, None)},
            "the sensor's ty clips at 50.0 mN.m",
        ),
        (
            "bias_step",
            {"step": [Interval(0.2, 0.19, 0.21)] + [Interval(0.0, -0.01, 0.01)] * 2
             + [Interval(0.003, 0.0029, 0.0031)] + [Interval(0.0, -1e-4, 1e-4)] * 2,
             "time_s": Interval(12.0, 11.9, 12.1), "bag": "motion"},
            "the sensor's reading jumps by 0.200 N (0.190 to 0.210) in fx, 3.00 mN.m (2.90 to 3.10)"
            " in tx at 12.00 s (11.90 to 12.10) of motion",
        ),
    ],
)  # fmt: skip
def test_parameters_in_units_that_people_read(effect, parameters, expected):
    assert cause_words(FoundCause(effect, 1.0, parameters, (), None, joint="tilt")) == expected


def test_a_number_without_an_uncertainty_has_three_digits_and_zero_has_no_sign():
    assert (plain(0.5, 0.0), plain(-1e-4, 0.01), plain(np.nan, 0.1)) == ("0.5", "0.000", "?")


def test_sentences_of_the_verdicts():
    answer, ambiguous = example_answer(), example_answer("ambiguous")
    assert sentence(example_answer("none")).startswith("No gap")
    assert "no effect on the list explains" in sentence(example_answer("unknown"))
    assert sentence(answer) == (
        "The tilt joint's zero is off by 0.584° (0.567 to 0.602). Probability 93 %; with it in the"
        " model 98% (97% to 99%) of the gap closes. Brackets: 95 % intervals."
    )
    assert (
        "Whether there is more, this recording can't decide: perhaps the sensor is turned in its"
        " mount, by 0.57° (0.52 to 0.63) about y, probability 45 %, or zero of the tilt joint"
    ) in sentence(ambiguous)
    unsure = replace(
        ambiguous, causes=tuple(replace(cause, probability=0.5) for cause in ambiguous.causes)
    )
    assert "this recording doesn't show what causes it: " in sentence(unsure)
    many = replace(unsure.causes[0], equivalent=tuple(EFFECTS)[3:20])
    assert "or one of 17 other effects" in sentence(replace(unsure, causes=(many,)))
    mass = FoundCause("tool_mass_error", 0.9, {"delta_kg": Interval(0.005, 0.0048, 0.0052)},
                      ("axis_gain",), None)  # fmt: skip
    two = sentence(replace(answer, causes=(*answer.causes, mass)))
    assert "; and the tool's true mass differs from its file's by 5.00 g (4.80 to 5.20)" in two
    assert "with them in the model 98%" in two and "(axis_gain)" in two


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        (1.0, "more than 99.9 %"), (0.996, "99.6 %"), (0.934, "93 %"), (0.004, "0.4 %"),
        (0.0, "less than 0.1 %"),
    ],
)  # fmt: skip
def test_a_probability_is_never_certain_in_words(probability, expected):
    assert probability_words(probability) == expected


def test_every_verdict_has_a_next_step():
    assert next_steps(example_answer("none"))[0].startswith("Nothing")
    assert next_steps(example_answer("ambiguous"))[-1] == "Push."
    assert "not on" not in next_steps(example_answer("unknown"))[0]
    answer = example_answer()
    twin = replace(answer.causes[0], equivalent=("sensor_mount_rotation",))
    (step,) = next_steps(replace(answer, causes=(twin,)))
    assert step.startswith("Rule out turned sensor (sensor_mount_rotation); then set the tilt")


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (Excluded("x", because="no tracker"), "no tracker"),
        (Excluded("crosstalk", {"from": "ty", "to": "fz", "coefficient": 0.1}),
         "0.100 N/N.m of ty in fz"),
        (Excluded("axis_gain", {"gain": [0.004, None, 0.005, 0.004, 0.004, 0.004]}),
         "0.400 % in fx, ? % in fy, 0.500 % in fz, 0.400 % in tx, 0.400 % in ty, 0.400 % in tz"),
        (Excluded("backlash", {"joint": "roll", "gap_rad": 3e-5}, because="not seen: joint tilt"),
         "0.00172° (0.03 mrad) at roll; not seen: joint tilt"),
        (Excluded("joint_compliance", {"stiffness": {"tilt": 1420.0}}),
         "down to tilt 1420 N.m/rad"),
        (Excluded("sensor_saturation", None, {"limit": [9.0, 8.0, 7.0, 0.5, 0.4, 0.3]}),
         "beyond the largest readings: 9.0 N in fx, 8.0 N in fy, 7.0 N in fz, 500 mN.m in tx,"
         " 400 mN.m in ty, 300 mN.m in tz"),
    ],
)  # fmt: skip
def test_sizes_that_would_have_been_missed_in_words(one, expected):
    assert missed_words(one) == expected


# --- what was tested and excluded


def test_detection_strength_is_where_the_posterior_turns():
    settings, nothing = load_settings(), Scored((), 0.0, 0.0)
    strength = detection_strength(settings, "tool_mass_error", 3.0, nothing)
    for factor, found in ((0.98, False), (1.02, True)):
        energy = (factor * strength) ** 2
        of = [Scored((), energy, 0.0), Scored(("tool_mass_error",), 0.0, 3.0)]
        assert (posterior(of, settings).none < NO_GAP) == found
    assert detection_strength(settings, "tool_mass_error", 8.0, nothing) > strength


@pytest.mark.slow
def test_twice_the_size_that_would_be_missed_is_found_and_half_of_it_is_not(tmp_path):
    """The mass alone, of the sweep: no tracker, no motion."""

    def looked_at(name, effects=()):
        make_recording(tmp_path / name, effects, seed=4, bags=("sweep",), arm=GALEN)
        explored = explore(read_recording(tmp_path / name))
        return explored, posterior(explored.scored, settings)

    settings = load_settings()
    healthy, chances = looked_at("healthy")
    assert chances.none > NO_GAP
    told = {one.label: one for one in excluded_effects(healthy, None, (), "none", settings)}
    assert told["tracker_scale"].because == "no tracker"
    assert told["tracker_scale"].missed_below is None
    assert len(told["axis_gain"].missed_below["gain"]) == 6
    assert {type(one.to_json()) for one in told.values()} == {dict}
    assert dict(data_words(healthy.observation.recording))["recording"] == "healthy"
    size = told["tool_mass_error"].missed_below["delta_kg"]
    for factor, found in ((0.5, False), (2.0, True)):
        _, chances = looked_at(f"times {factor}", (ToolMassError(factor * size),))
        assert (chances.none < NO_GAP) == found
        assert (chances.effects["tool_mass_error"] > 1.0 - NO_GAP) == found
    unknown = excluded_effects(healthy, None, (), "unknown", settings)
    assert all(one.missed_below is None and one.because for one in unknown)


def test_driver_file_gives_the_driver_what_was_found():
    effects = (JointZeroOffset("tilt", 0.0102),)
    ((node, below),) = yaml.safe_load(effect_file("a\n- {injected: 1}", effects, arm=GALEN)).items()
    assert node == "/**/sim_driver"
    assert effects_of(EffectParameters(**below["ros__parameters"])) == effects
    assert effect_file("a", (), arm=GALEN) is None
    with pytest.raises(ConfigError):
        effect_file("a", effects * 2, arm=GALEN)


def test_an_answer_of_nothing_but_a_verdict_makes_a_page():
    assert "Diagnosis of r" in report(Answer("r", "unknown", (), (), {}, {}), {})
