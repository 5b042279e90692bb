import json

import numpy as np
import pytest
from galen_diagnosis.blind.labels import Label, ParsedAnswer, label_from_json, parse_answer
from galen_diagnosis.blind.rates import Rate, calibration, compare
from galen_diagnosis.blind.score import Answered, markdown, score, wrong_answers
from galen_model.files.json_fields import FieldError

EFFECTS = ("alpha", "beta", "gamma")


def label(name, kind="single", effects=("alpha",), **others):
    parameters = others.pop("parameters", {})
    found = tuple({"effect": effect, "parameters": parameters} for effect in effects)
    return Label(name, kind, found, **others)


def said(name, ranking, verdict="identified", causes=None, **others):
    first = max(ranking, key=ranking.get)
    if causes is None:
        causes = {} if first in ("none", "unknown") else {first: {}}
    return ParsedAnswer(
        name, verdict, causes, others.pop("equivalent", frozenset()), ranking, **others
    )


def one(truth, answer):
    return Answered(truth, answer)


def singles(strength, right, wrong, verdict="identified", effect="alpha"):
    """So many of an effect told right, and so many taken for gamma."""
    truth = label("r", effects=(effect,), strength=strength)
    return [one(truth, said("r", {effect: 0.9, "none": 0.1}))] * right + [
        one(truth, said("r", {"gamma": 0.8, effect: 0.2}, verdict))
    ] * wrong


def healthy(none, alarms):
    truth = label("h", "none", ())
    return [one(truth, said("h", {"none": 1.0}, "none"))] * none + [
        one(truth, said("h", {"beta": 0.7, "none": 0.3}))
    ] * alarms


def test_top1_is_counted_by_class_and_strength():
    cases = (
        singles("clear", 3, 1)
        + singles("gross", 4, 0)
        + singles("clear", 1, 1, effect="beta")
        + singles("faint", 0, 5)
    )
    found = score(cases, EFFECTS)
    assert found.rates["top1_clear"] == Rate(4, 6)
    assert found.rates["top1_gross"] == Rate(4, 4)
    assert found.rates["top1_faint"] == Rate(0, 5)
    # alpha 7 of 8 and beta 1 of 2 count alike, faint ones and the class without any don't
    assert found.numbers["top1_by_class"] == pytest.approx((7 / 8 + 1 / 2) / 2)
    names = found.names
    assert names == ("none", *EFFECTS, "unknown")
    counts = found.confusion
    assert counts[names.index("alpha"), names.index("gamma")] == 6
    assert counts[names.index("alpha"), names.index("alpha")] == 7
    assert counts.sum() == len(cases)


def test_a_twin_of_the_recording_counts_as_accepted_only():
    truth = label("r", strength="clear", acceptable=(("alpha", "gamma"),))
    found = score([one(truth, said("r", {"gamma": 0.6, "alpha": 0.4}, "ambiguous"))], EFFECTS)
    assert found.rates["top1_clear"] == Rate(0, 1)
    assert (found.numbers["top1_by_class"], found.numbers["top1_by_class_accepted"]) == (0.0, 1.0)
    other = said("r", {"beta": 0.6, "alpha": 0.4})
    assert score([one(truth, other)], EFFECTS).numbers["top1_by_class_accepted"] == 0.0


def test_the_order_of_the_ranking_does_not_matter():
    truth = label("r", strength="clear")
    ranking = {"none": 0.1, "unknown": 0.2, "alpha": 0.7}
    assert score([one(truth, said("r", ranking))], EFFECTS).rates["top1_clear"] == Rate(1, 1)


def test_false_alarms_go_by_the_verdict():
    found = score(healthy(37, 3), EFFECTS)
    assert found.rates["false_alarms"] == Rate(3, 40)
    # Wilson's interval of 3 of 40, from his equation
    z, p, n = 1.959964, 3 / 40, 40
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert found.rates["false_alarms"].interval == pytest.approx(
        (middle - half, middle + half), rel=1e-5
    )
    assert Rate(0, 0).value is None and Rate(0, 0).interval is None


def test_unknown_is_found_at_a_threshold_that_5_percent_of_the_known_pass():
    known = [
        one(
            label("k", strength="clear"),
            said("k", {"alpha": 1 - p, "unknown": p}, "unknown" if p > 0.9 else "identified"),
        )
        for p in np.arange(40) / 40.0
    ]
    strange = [
        one(
            label("u", "unknown", (kind,)),
            said("u", {"alpha": 1 - p, "unknown": p}, "unknown" if p > 0.95 else "ambiguous"),
        )
        for kind, p in (("hail", 0.99), ("hail", 0.94), ("rust", 0.93), ("rust", 0.2))
    ]
    found = score(known + strange, EFFECTS)
    # Two of forty may pass: 39/40 and 38/40 do, 37/40 doesn't.
    assert found.numbers["unknown_threshold"] == pytest.approx(37 / 40)
    assert found.rates["unknown_at_5_percent"] == Rate(3, 4)
    assert found.rates["unknown_by_verdict"] == Rate(1, 4)
    assert found.rates["known_called_unknown"] == Rate(3, 40)
    assert found.by_unknown == {"hail": Rate(1, 2), "rust": Rate(0, 2)}


def test_faint_ones_may_stay_open_but_not_be_wrong_and_sure():
    cases = (
        singles("faint", 2, 0)
        + singles("faint", 0, 1)
        + singles("faint", 0, 3, "ambiguous")
        + [one(label("r", strength="faint"), said("r", {"none": 0.6, "alpha": 0.4}, "none"))]
        + [
            one(
                label("r", strength="faint", acceptable=(("alpha", "gamma"),)),
                said("r", {"gamma": 1.0}),
            )
        ]
    )
    found = score(cases, EFFECTS)
    assert found.rates["faint_wrong_and_sure"] == Rate(1, 8)
    assert found.rates["faint_open"] == Rate(3, 8)
    assert found.rates["faint_called_none"] == Rate(1, 8)


def test_pairs_by_their_causes():
    truth = label("p", "pair", ("alpha", "beta"), strength="clear")
    both = said("p", {"alpha": 1.0}, causes={"alpha": {}, "beta": {}})
    half = said("p", {"alpha": 1.0}, causes={"alpha": {}})
    three = said("p", {"alpha": 1.0}, causes={"alpha": {}, "beta": {}, "gamma": {}})
    found = score([one(truth, answer) for answer in (both, half, three)], EFFECTS)
    assert found.rates["pairs_precision"] == Rate(5, 6)
    assert found.rates["pairs_recall"] == Rate(5, 6)
    assert found.numbers["pairs_f1"] == pytest.approx(5 / 6)
    assert found.rates["pairs_whole"] == Rate(1, 3)
    # beta can't be told from gamma; but one cause doesn't stand for both effects
    twin = label(
        "p", "pair", ("alpha", "beta"), acceptable=(("alpha",), ("beta", "gamma")), strength="clear"
    )
    other = said("p", {"alpha": 1.0}, causes={"alpha": {}, "gamma": {}})
    assert score([one(twin, other)], EFFECTS).rates["pairs_whole"] == Rate(1, 1)
    assert score([one(twin, three)], EFFECTS).rates["pairs_recall"] == Rate(2, 2)
    assert score([one(twin, three)], EFFECTS).rates["pairs_whole"] == Rate(0, 1)
    merged = label(
        "p", "pair", ("alpha", "beta"), acceptable=(("alpha", "beta"), ("alpha", "beta"))
    )
    assert score([one(merged, half)], EFFECTS).rates["pairs_recall"] == Rate(1, 2)


def test_ambiguous_ones_want_the_whole_set():
    truth = label("a", "ambiguous", ("alpha",), acceptable=(("alpha", "beta"),))
    whole = said("a", {"alpha": 0.5, "beta": 0.5}, "ambiguous", equivalent=frozenset({"beta"}))
    two = said("a", {"beta": 1.0}, "ambiguous", causes={"alpha": {}, "beta": {}})
    alone = said("a", {"alpha": 1.0})
    silent = said("a", {"unknown": 1.0}, "unknown")
    found = score([one(truth, answer) for answer in (whole, two, alone, silent)], EFFECTS)
    assert found.rates["ambiguous_whole"] == Rate(2, 4)
    assert found.rates["ambiguous_sure_of_less"] == Rate(1, 4)


def test_a_failed_diagnosis_is_wrong_everywhere():
    cases = [
        one(label("r", strength="clear"), None),
        one(label("h", "none", ()), None),
        one(label("u", "unknown", ("hail",)), None),
        one(label("p", "pair", ("alpha", "beta")), None),
        one(label("a", "ambiguous", ("alpha",), acceptable=(("alpha", "beta"),)), None),
    ]
    found = score(cases, EFFECTS)
    assert found.failed == 5
    assert found.rates["top1_clear"] == Rate(0, 1)
    assert found.rates["false_alarms"] == Rate(1, 1)
    assert found.rates["unknown_at_5_percent"] == Rate(0, 1)
    assert found.numbers["pairs_f1"] == 0.0
    assert found.rates["ambiguous_whole"] == Rate(0, 1)
    assert found.numbers["calibration_error"] is None


def test_calibration_of_probabilities_that_hold_and_that_do_not():
    random = np.random.default_rng(3)
    sure = random.uniform(0.34, 1.0, 4000)
    right = random.random(4000) < sure
    rankings = [{"alpha": p, "beta": 0.7 * (1 - p), "none": 0.3 * (1 - p)} for p in sure]
    truths = ["alpha" if hit else "beta" for hit in right]
    found = calibration(rankings, truths)
    assert found["calibration_error"] < 3.0 * found["calibration_error_by_chance"] < 0.04
    worse = [{"alpha": p**0.2, "beta": 1 - p**0.2} for p in sure]
    assert calibration(worse, truths)["calibration_error"] > 0.15
    # by hand: one right at 0.8, one wrong at 0.6
    few = calibration([{"a": 0.8, "b": 0.2}, {"a": 0.6, "b": 0.4}], ["a", "b"])
    assert few["calibration_error"] == pytest.approx((0.2 + 0.6) / 2)
    assert few["brier"] == pytest.approx((0.04 + 0.04 + 0.36 + 0.36) / 2)
    assert few["log_score"] == pytest.approx(-(np.log(0.8) + np.log(0.4)) / 2)
    assert calibration([{"a": 1.0}], ["c"])["brier"] == pytest.approx(2.0)


def test_errors_in_own_sigma_and_coverage():
    true = {"offset_rad": 0.010, "step": [1.0, 2.0], "axis": "fx"}
    told = {
        "offset_rad": {"value": 0.012, "ci95": [0.012 - 1.959964e-3, 0.012 + 1.959964e-3]},
        "step": {"value": [1.1, 2.0], "ci95": [[0.9, 1.3], None]},
        "axis": "fx",
    }
    (offset, first, second), words = compare("r", "alpha", true, told)
    assert words is True
    assert offset.in_sigma == pytest.approx(2.0)
    assert offset.covered is False
    assert (first.name, first.covered) == ("step[0]", True)
    assert (second.in_sigma, second.covered) == (None, None)
    wrong = compare("r", "alpha", true, {**told, "axis": {"value": "fy", "ci95": None}})
    assert wrong == ([], False)
    assert compare("r", "alpha", true, {"axis": "fx"}) == ([], True)
    # all through the score: two recordings, one within its interval
    truth = label("r", strength="gross", parameters={"gain": 0.02})
    answers = [
        said("r", {"alpha": 1.0}, causes={"alpha": {"gain": {"value": v, "ci95": [low, high]}}})
        for v, low, high in ((0.0205, 0.0195, 0.0215), (0.025, 0.024, 0.026))
    ]
    total = score([one(truth, answer) for answer in answers], EFFECTS)
    assert total.rates["coverage"] == Rate(1, 2)
    sigma = 1e-3 / 1.959964
    expected = np.sqrt(((0.0005 / sigma) ** 2 + (0.005 / sigma) ** 2) / 2)
    assert total.numbers["rms_error_sigma"] == pytest.approx(expected)


def test_tables_and_json_agree():
    cases = singles("clear", 19, 1) + singles("gross", 5, 0) + healthy(30, 1)
    cases.append(
        one(
            label("r", strength="clear", parameters={"gain": 0.02}),
            said(
                "r",
                {"alpha": 1.0},
                causes={"alpha": {"gain": {"value": 0.021, "ci95": [0.019, 0.023]}}},
            ),
        )
    )
    found = score(cases, EFFECTS)
    text = markdown({"program": found, "naive": score(healthy(1, 0), EFFECTS)})
    assert "| healthy: false alarms | ≤ 3 % | 3 % (1–16), 1 of 31 |" in text
    assert "| `alpha` |  | 20/21 | 5/5 |  |  |" in text
    assert "alpha taken for gamma: 1 of 26" in text
    content = json.loads(json.dumps(found.to_json()))
    assert content["rates"]["top1_clear"]["hits"] == 20
    assert content["rates"]["false_alarms"]["of"] == 31
    assert content["errors"][0]["covered"] is True


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"verdict": "sure"}, "verdict"),
        ({"ranking": []}, "ranking"),
        ({"ranking": [{"effect": "alpha", "probability": 1.4}]}, "probability"),
        ({"ranking": [{"probability": 1.0}]}, "effect"),
    ],
)
def test_answers_that_make_no_sense_are_rejected(change, names):
    content = {
        "verdict": "identified",
        "causes": [{"effect": "alpha", "parameters": {}, "equivalent": ["beta"]}],
        "ranking": [
            {"effect": "none", "probability": 0.2},
            {"effect": "alpha", "probability": 0.8},
        ],
    }
    good = parse_answer("r", content, 2.0)
    assert (good.first, good.named) == ("alpha", {"alpha", "beta"})
    with pytest.raises(FieldError, match=names):
        parse_answer("r", {**content, **change})


def test_labels_survive_their_file_and_wrong_ones_are_rejected():
    truth = label(
        "r", "pair", ("alpha", "beta"), acceptable=(("alpha",), ("beta", "gamma")), d=31.0
    )
    content = json.loads(json.dumps(truth.to_json()))
    assert label_from_json(content) == truth
    for change, names in (
        ({"kind": "triple"}, "kind"),
        ({"effects": []}, "0 effects"),
        ({"hint": 1}, "hint"),
    ):
        with pytest.raises(FieldError, match=names):
            label_from_json({**content, **change})


def test_effects_of_joints_are_read_with_their_joint():
    content = {
        "verdict": "ambiguous",
        "causes": [
            {"effect": "base_inclination", "parameters": {}, "equivalent": ["joint_zero_offset"],
             "equivalent_joints": {"joint_zero_offset": ["roll"]}},
            {"effect": "joint_gain", "joint": "tilt", "parameters": {"gain": 0.1}},
        ],
        "ranking": [{"effect": "joint_gain", "joint": "tilt", "probability": 0.8},
                    {"effect": "joint_zero_offset", "joint": "roll", "probability": 0.7}],
        "gap": {},
    }  # fmt: skip
    answer = parse_answer("r", content)
    assert answer.first == "joint_gain:tilt"
    assert answer.named == {"base_inclination", "joint_zero_offset:roll", "joint_gain:tilt"}
    assert answer.causes["joint_gain:tilt"] == {"joint": "tilt", "gain": 0.1}


@pytest.mark.parametrize(
    ("truth", "answer", "right"),
    [
        (label("r", "none", ()), said("r", {"none": 1.0}, "none"), True),
        (label("r", "none", ()), said("r", {"alpha": 1.0}), False),
        (label("r", "unknown", ("hail",)), said("r", {"unknown": 1.0}, "unknown"), True),
        (label("r", "unknown", ("hail",)), said("r", {"alpha": 1.0}), False),
        (label("r", "single", ("alpha",)), said("r", {"alpha": 1.0}), True),
        (label("r", "single", ("alpha",)), said("r", {"alpha": 1.0}, "ambiguous"), False),
        (label("r", "single", ("alpha",)), said("r", {"beta": 1.0}), False),
        (
            label("r", "single", ("alpha",), strength="faint"),
            said("r", {"none": 1.0}, "none"),
            True,
        ),
        (label("r", "single", ("alpha",), strength="faint"), said("r", {"beta": 1.0}), False),
        (label("r", "pair", ("alpha", "beta")), said("r", {"alpha": 1.0}), False),
        (
            label("r", "pair", ("alpha", "beta")),
            said("r", {"alpha": 1.0}, causes={"alpha": {}, "beta": {}}),
            True,
        ),
        (
            label("r", "single", ("alpha",), acceptable=(("alpha", "beta"),)),
            said("r", {"beta": 1.0}, "ambiguous"),
            True,
        ),
    ],
)
def test_every_answer_of_a_short_check_must_be_right(truth, answer, right):
    assert (wrong_answers([Answered(truth, answer)]) == []) == right
    assert wrong_answers([Answered(truth, None)]) == [
        f"r: no answer of {' and '.join(truth.names) or 'none'}"
    ]
