# SPDX-License-Identifier: Apache-2.0
import json
import re
from pathlib import Path

import numpy as np
import pytest
from galen_model.errors import GalenError
from galen_model.json_fields import FieldError

from galen_validation import blind_check
from galen_validation.blind.answers import Estimate, parse_answer, read_answer
from galen_validation.blind.labels import Label, beside, label_from_json, sealed
from galen_validation.blind.score import (
    Answered,
    Rate,
    calibration,
    read_answers,
    score,
)
from galen_validation.blind.table import LINES, fill, tables


def label(name, kind="single", effects=("alpha",), parameters=None, member="", **others):
    found = tuple({"effect": effect, "parameters": parameters or {}} for effect in effects)
    if member:
        found = tuple({**one, "member": member} for one in found)
    return Label(name, kind, found, **others)


def content(ranking, verdict="identified", causes=None, **others):
    """An answer as JSON has it; causes: names, or names with parameters, or with equivalents."""
    first = max(ranking, key=ranking.get)
    if causes is None:
        causes = [] if first in ("none", "unknown") else [first]
    return {
        "verdict": verdict,
        "causes": [
            {"effect": one, "parameters": {}} if isinstance(one, str) else one for one in causes
        ],
        "ranking": [{"effect": name, "probability": p} for name, p in ranking.items()],
        **others,
    }


def said(*arguments, **others):
    return parse_answer(content(*arguments, **others))


def singles(strength, right, wrong, verdict="identified", effect="alpha", **others):
    """So many of an effect told right, and so many taken for gamma."""
    truth = label("r", effects=(effect,), strength=strength, **others)
    return [Answered(truth, said({effect: 0.9, "none": 0.1}))] * right + [
        Answered(truth, said({"gamma": 0.8, effect: 0.2}, verdict))
    ] * wrong


def healthy(none, alarms):
    truth = label("h", "none", ())
    return [Answered(truth, said({"none": 1.0}, "none"))] * none + [
        Answered(truth, said({"beta": 0.7, "none": 0.3}))
    ] * alarms


def test_top1_is_counted_by_class_and_strength():
    cases = (
        singles("clear", 3, 1)
        + singles("gross", 4, 0)
        + singles("clear", 1, 1, effect="beta")
        + singles("faint", 0, 5)
    )
    found = score(cases)
    assert found.values["top1_clear"] == Rate(4, 6)
    assert found.values["top1_gross"] == Rate(4, 4)
    assert found.values["top1_faint"] == Rate(0, 5)
    # alpha 7 of 8 and beta 1 of 2 count alike, faint ones don't
    assert found.values["top1_by_class"] == pytest.approx((7 / 8 + 1 / 2) / 2)
    assert found.classes["beta"] == {"clear": Rate(1, 2)}
    assert found.confusions == {("alpha", "gamma"): 6, ("beta", "gamma"): 1}


def test_a_twin_of_the_recording_counts_as_accepted_only():
    truth = label("r", strength="clear", acceptable=(("alpha", "gamma"),))
    values = score([Answered(truth, said({"gamma": 0.6, "alpha": 0.4}, "ambiguous"))]).values
    assert values["top1_clear"] == Rate(0, 1)
    assert (values["top1_by_class"], values["top1_by_class_accepted"]) == (0.0, 1.0)
    other = said({"beta": 0.6, "alpha": 0.4})
    assert score([Answered(truth, other)]).values["top1_by_class_accepted"] == 0.0


def test_false_alarms_and_detection_go_by_the_verdict():
    values = score(healthy(37, 3)).values
    assert values["false_alarms"] == Rate(3, 40)
    # Wilson's interval of 3 of 40, from his equation
    z, p, n = 1.959964, 3 / 40, 40
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert values["false_alarms"].interval == pytest.approx(
        (middle - half, middle + half), rel=1e-5
    )
    missed = Answered(label("r", strength="clear"), said({"alpha": 0.5, "none": 0.4}, "none"))
    assert score([missed, *singles("gross", 1, 1), *singles("faint", 1, 0)]).values["detected"] == (
        Rate(2, 3)
    )


def test_changes_since_a_reference_are_rates_of_their_own():
    changed = label("c", "changed", strength="clear")
    cases = [
        Answered(changed, said({"alpha": 0.9})),
        Answered(changed, said({"alpha": 0.9}, causes=["alpha", "gamma"])),
        Answered(changed, said({"none": 0.9}, "none")),
        Answered(label("u", "unchanged", ()), said({"none": 0.9}, "none")),
        Answered(label("u", "unchanged", ()), said({"alpha": 0.9})),
    ]
    assert [case.solved for case in cases] == [True, True, False, True, False]
    values = score(cases).values
    assert values["changed_named"] == Rate(2, 3) and values["changed_whole"] == Rate(1, 3)
    assert values["unchanged_alarms"] == Rate(1, 2)
    assert values["false_alarms"].of == values["top1_clear"].of == 0


def test_unlisted_causes_go_by_the_verdict_and_by_kind():
    cases = [
        Answered(label("u", "unknown", (kind,), strength="clear"), said({"unknown": 0.9}, verdict))
        for kind, verdict in (("hail", "unknown"), ("hail", "ambiguous"), ("rust", "identified"))
    ]
    cases += [Answered(label("k", strength="clear"), said({"unknown": 1.0}, "unknown"))]
    found = score(cases)
    assert found.values["unlisted"] == Rate(1, 3)
    assert found.values["known_called_unknown"] == Rate(1, 1)
    assert found.classes["hail"] == {"clear": Rate(1, 2)}


@pytest.mark.parametrize(
    ("truth", "answer", "wrong"),
    [
        (label("r"), said({"alpha": 1.0}), False),
        (label("r"), said({"beta": 1.0}), True),
        (label("r"), said({"beta": 1.0}, "ambiguous"), False),
        (label("r"), said({"alpha": 1.0}, causes=["alpha", "beta"]), True),
        (label("r", acceptable=(("alpha", "beta"),)), said({"beta": 1.0}), False),
        (
            label("r"),
            said({"beta": 1.0}, causes=[{"effect": "beta", "equivalent": ["alpha"]}]),
            False,
        ),
        (label("r"), said({"none": 1.0}, "none"), True),
        (label("r", strength="faint"), said({"none": 1.0}, "none"), False),
        (label("r", strength="faint"), said({"beta": 1.0}), True),
        (label("r", "none", ()), said({"beta": 1.0}), True),
        (label("r", "none", ()), said({"none": 1.0}, "none"), False),
        (label("r", "unknown", ("hail",)), said({"beta": 1.0}), True),
        (label("r", "unknown", ("hail",)), said({"unknown": 1.0}, "unknown"), False),
        # Sure of one of two isn't sure of a wrong one; that it lacks one is counted with the pairs.
        (label("r", "pair", ("alpha", "beta")), said({"alpha": 1.0}), False),
        (label("r"), None, False),
    ],
)
def test_wrong_and_sure(truth, answer, wrong):
    assert score([Answered(truth, answer)]).values["wrong_and_sure"] == Rate(int(wrong), 1)


def test_pairs_want_both_effects_by_different_causes():
    truth = label("p", "pair", ("alpha", "beta"), strength="clear")
    both, half, three = (
        said({"alpha": 1.0}, causes=causes)
        for causes in (["alpha", "beta"], ["alpha"], ["alpha", "beta", "gamma"])
    )
    values = score([Answered(truth, answer) for answer in (both, half, three)]).values
    assert (values["pairs_named"], values["pairs_whole"]) == (Rate(2, 3), Rate(1, 3))
    # beta can't be told from gamma; but one cause doesn't stand for both effects
    twin = label("p", "pair", ("alpha", "beta"), acceptable=(("alpha",), ("beta", "gamma")))
    other = said({"alpha": 1.0}, causes=["alpha", "gamma"])
    assert score([Answered(twin, other)]).values["pairs_whole"] == Rate(1, 1)
    merged = label(
        "p", "pair", ("alpha", "beta"), acceptable=(("alpha", "beta"), ("alpha", "beta"))
    )
    assert score([Answered(merged, half)]).values["pairs_named"] == Rate(0, 1)


def test_twins_want_the_whole_set():
    truth = label("a", "ambiguous", ("alpha",), acceptable=(("alpha", "beta"),))
    whole = said({"alpha": 0.5}, "ambiguous", [{"effect": "alpha", "equivalent": ["beta"]}])
    two = said({"beta": 1.0}, "ambiguous", causes=["alpha", "beta"])
    answers = (whole, two, said({"alpha": 1.0}), said({"unknown": 1.0}, "unknown"))
    values = score([Answered(truth, answer) for answer in answers]).values
    assert values["twins_named"] == Rate(2, 4)


def test_members_show_what_a_model_outside_the_family_does():
    cases = singles("clear", 2, 1, member="soft") + singles("gross", 1, 0, member="hard")
    cases += singles("faint", 0, 4, member="soft") + singles("clear", 1, 0)
    unknown = said({"unknown": 1.0}, "unknown")
    cases.append(Answered(label("r", strength="clear", member="soft"), unknown))
    assert score(cases).members == {
        ("alpha", "hard"): (Rate(1, 1), Rate(0, 1), Rate(0, 1)),
        ("alpha", "soft"): (Rate(2, 4), Rate(1, 4), Rate(1, 4)),
    }


def test_calibration_of_probabilities_that_hold_and_that_do_not():
    random = np.random.default_rng(3)
    sure = random.uniform(0.34, 1.0, 4000)
    right = random.random(4000) < sure
    rankings = [{"alpha": p, "beta": 0.7 * (1 - p), "none": 0.3 * (1 - p)} for p in sure]
    truths = ["alpha" if hit else "beta" for hit in right]
    found = calibration(list(zip(rankings, truths, strict=True)))
    assert found["calibration_error"] < 3.0 * found["calibration_error_by_chance"] < 0.04
    worse = [{"alpha": p**0.2, "beta": 1 - p**0.2} for p in sure]
    assert calibration(list(zip(worse, truths, strict=True)))["calibration_error"] > 0.15
    # by hand: one right at 0.8, one wrong at 0.6
    few = calibration([({"a": 0.8, "b": 0.2}, "a"), ({"a": 0.6, "b": 0.4}, "b")])
    assert few["calibration_error"] == pytest.approx((0.2 + 0.6) / 2)
    assert few["brier"] == pytest.approx((0.04 + 0.04 + 0.36 + 0.36) / 2)
    assert calibration([({"a": 1.0}, "c")])["brier"] == pytest.approx(2.0)
    # Faint causes and pairs stay out of it.
    cases = [*singles("clear", 1, 0), *singles("faint", 0, 3)]
    assert score(cases).values["calibration_error"] == pytest.approx(0.1)


def test_parameters_are_compared_where_the_cause_and_its_words_are_right():
    truth = label(
        "r", strength="gross",
        parameters={"offset_rad": 0.010, "step": [1.0, -2.0], "axis": "fx", "k": {"roll": 5.0}},
    )  # fmt: skip
    told = {
        "offset_rad": {"value": 0.012, "ci95": [0.011, 0.013]},
        "step": {"value": [1.1, -2.0], "ci95": [[0.9, 1.3], None]},
        "axis": "fx",
        "k": {"roll": 6.0},
        "more": None,
    }

    def found(parameters):
        cause = {"effect": "alpha", "parameters": parameters}
        return score([Answered(truth, said({"alpha": 1.0}, causes=[cause]))])

    errors = {one.name: one for one in found(told).errors}
    assert list(errors) == ["offset_rad", "step[0]", "step[1]", "k.roll"]
    assert [one.covered for one in errors.values()] == [False, True, None, None]
    assert [one.relative for one in errors.values()] == pytest.approx([0.2, 0.05, 0.0, 0.2])
    values = found(told).values
    assert (values["coverage"], values["told"]) == (Rate(1, 2), Rate(2, 4))
    assert values["relative_error"] == pytest.approx(0.125)
    wrong = found({**told, "axis": {"value": "fy", "ci95": None}})
    assert wrong.errors == () and wrong.values["words"] == Rate(0, 1)
    assert found({"axis": "fx"}).values["told"] == Rate(0, 4)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (None, "no answer"),
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON|nested"),
        ('{"a":' * 900 + "1" + "}" * 900, "verdict is missing"),
        ("[]", "not an object"),
        ("{}", "verdict is missing"),
        ({"verdict": "sure"}, "verdict"),
        ({"ranking": []}, "ranking"),
        ({"ranking": [{"effect": "alpha", "probability": 1.4}]}, "probability"),
        ({"ranking": [{"effect": "alpha", "probability": float("nan")}]}, "probability"),
        ({"ranking": [{"probability": 1.0}]}, "effect"),
        ({"causes": {"alpha": 1.0}}, "causes"),
        ({"causes": [{"effect": "alpha", "parameters": [1.0]}]}, "parameters"),
        ({"causes": [{"effect": "alpha", "parameters": {"x": {"value": 1, "ci95": [2]}}}]}, "ci95"),
        ({"causes": [{"effect": "alpha", "parameters": {"x": [1.0, {}]}}]}, "x"),
        ({"causes": [{"effect": "alpha", "equivalent": "beta"}]}, "equivalent"),
        ({"seconds": "fast"}, "seconds"),
    ],
)
def test_bad_answers_are_failed_diagnoses_and_named(tmp_path, text, names):
    if isinstance(text, dict):
        text = json.dumps({**content({"alpha": 1.0}), **text})
    if text is not None:
        (tmp_path / "r.json").write_text(text)
    (case,) = read_answers([label("r", strength="clear")], tmp_path)
    with pytest.raises(FieldError, match=names):
        read_answer(tmp_path, "r")
    assert case.said is None and case.why
    found = score([case])
    assert found.failed == {"r": case.why} and found.values["failed"] == Rate(1, 1)
    assert found.values["top1_clear"] == found.values["detected"] == Rate(0, 1)


def test_missing_answers_are_wrong_everywhere():
    cases = [
        Answered(label("r", strength="clear"), None),
        Answered(label("h", "none", ()), None),
        Answered(label("u", "unknown", ("hail",)), None),
        Answered(label("p", "pair", ("alpha", "beta")), None),
        Answered(label("a", "ambiguous", ("alpha",), acceptable=(("alpha", "beta"),)), None),
    ]
    values = score(cases).values
    for name in ("top1_clear", "unlisted", "pairs_named", "twins_named"):
        assert values[name] == Rate(0, 1)
    assert values["false_alarms"] == Rate(1, 1) and values["failed"] == Rate(5, 5)
    assert values["calibration_error"] is None


def test_effects_of_joints_are_read_with_their_joint():
    answer = parse_answer({
        "verdict": "ambiguous",
        "causes": [
            {"effect": "base_inclination", "equivalent": ["joint_zero_offset", "axis_gain"],
             "equivalent_joints": {"joint_zero_offset": ["roll"]}},
            {"effect": "joint_gain", "joint": "tilt", "parameters": {"gain": 0.1}},
        ],
        "ranking": [{"effect": "joint_gain", "joint": "tilt", "probability": 0.8},
                    {"effect": "joint_zero_offset", "joint": "roll", "probability": 0.7}],
    })  # fmt: skip
    assert answer.first == "joint_gain:tilt"
    assert answer.named == {
        "base_inclination", "joint_zero_offset:roll", "axis_gain", "joint_gain:tilt"
    }  # fmt: skip
    parameters = answer.causes["joint_gain:tilt"].parameters
    assert parameters == {"joint": "tilt", "gain": Estimate(0.1)}


def test_labels_survive_their_file_and_wrong_ones_are_rejected():
    truth = label(
        "r", "pair", ("alpha", "beta"), acceptable=(("alpha",), ("beta", "gamma")), d=31.0
    )
    plain = json.loads(sealed({"seed": 1}, [truth])[0])["labels"][0]
    assert label_from_json(plain) == truth
    for change in (
        {"kind": "triple"}, {"effects": []}, {"hint": 1}, {"acceptable": [["alpha"]]},
        {"effects": [{}, {}]}, {"effects": 3},
    ):  # fmt: skip
        with pytest.raises(FieldError):
            label_from_json({**plain, **change})


@pytest.mark.parametrize(
    ("truth", "answer", "right"),
    [
        (label("r", "none", ()), said({"none": 1.0}, "none"), True),
        (label("r", "none", ()), said({"alpha": 1.0}), False),
        (label("r", "unknown", ("hail",)), said({"unknown": 1.0}, "unknown"), True),
        (label("r", "unknown", ("hail",)), said({"alpha": 1.0}), False),
        (label("r"), said({"alpha": 1.0}), True),
        (label("r"), said({"alpha": 1.0}, "ambiguous"), False),
        (label("r"), said({"beta": 1.0}), False),
        (label("r", "pair", ("alpha", "beta")), said({"alpha": 1.0}), False),
        (
            label("r", "pair", ("alpha", "beta")),
            said({"alpha": 1.0}, causes=["alpha", "beta"]),
            True,
        ),
        (label("r", acceptable=(("alpha", "beta"),)), said({"beta": 1.0}, "ambiguous"), True),
        (label("r"), None, False),
    ],
)
def test_every_answer_of_a_short_check_must_be_right(truth, answer, right):
    assert Answered(truth, answer).solved == right


@pytest.fixture
def a_set(tmp_path):
    """A set of three labels without recordings, and the answers of a tool in another language."""
    folder, tool = tmp_path / "set", tmp_path / "matlab"
    labels = [
        label("r1", strength="clear", parameters={"gain": 0.02}),
        label("r2", "none", (), arm="six_axis"),
        label("r3", strength="gross", member="soft"),
    ]
    text, told = sealed({"seed": 1, "per_class": 3, "healthy": 60, "short": False}, labels)
    for made in (folder, tool, beside(folder, "labels")):
        made.mkdir()
    (folder / "labels.sha256").write_text(f"{told}  labels.json\n")
    (beside(folder, "labels") / "labels.json").write_text(text)
    (tool / "r1.json").write_text(json.dumps(content({"alpha": 0.8, "none": 0.2})))
    (tool / "r2.json").write_text("{")
    return folder, tool


def test_any_tools_answers_become_tables_and_json(a_set, tmp_path, capsys):
    folder, tool = a_set
    page = tmp_path / "page.md"
    page.write_text(
        "# Ours\n\n<!-- score -->\nformer\n<!-- end -->\n\nWords.\n<!-- arms -->\n<!-- end -->\n"
    )
    asked = ["score", str(folder), str(tool), "--page", str(page)]
    assert blind_check.main(asked) == 0
    once = page.read_text()
    assert (
        once.startswith("# Ours\n\n<!-- score -->\n|  | goal | matlab |") and "former" not in once
    )
    assert "| healthy: false alarms | ≤ 3 % | 100 % (21–100), 1 of 1 |" in once
    assert "\nWords.\n" in once and "| galen | six_axis |" in once
    assert blind_check.main([*asked, "--json"]) == 0
    assert page.read_text() == once
    assert [path.name for path in tmp_path.glob("page*")] == ["page.md"]
    printed = capsys.readouterr().out
    assert "r2: not JSON" in printed and "r3: no answer" in printed
    values = json.loads(printed[printed.index("\n{") :])["scores"]["matlab"]["values"]
    assert {key for _, _, key in LINES} == set(values)
    assert values["top1_clear"]["hits"] == 1 and values["failed"]["hits"] == 2


def test_a_folder_without_answers_or_a_page_without_places_is_an_error(a_set, tmp_path, capsys):
    folder, tool = a_set
    (tmp_path / "empty").mkdir()
    assert blind_check.main(["score", str(folder), str(tmp_path / "empty")]) == 1
    assert "no recording has a valid answer" in capsys.readouterr().err
    page = tmp_path / "page.md"
    page.write_text("# Ours\n")
    assert blind_check.main(["score", str(folder), str(tool), "--page", str(page)]) == 1
    assert "no place for a table" in capsys.readouterr().err
    assert blind_check.main(["score", str(tmp_path / "nothing"), str(tool)]) == 1
    with pytest.raises(GalenError, match="can't be read"):
        fill(tmp_path / "missing.md", {})


@pytest.mark.parametrize(
    ("page", "table"), [("benchmark.md", "score"), ("results/diagnosis.md", "members")]
)
def test_pages_of_the_repository_have_places_for_tables_that_there_are(page, table):
    text = (Path(__file__).parents[2] / "docs" / page).read_text()
    names = re.findall(r"<!-- (?!end)(.*) -->", text)
    assert table in names and set(names) <= set(tables({"ours": singles("clear", 1, 0)}, ""))
    assert text.count("<!-- end -->") == len(names)


def test_tables_compare_tools_class_by_class():
    cases = singles("clear", 19, 1) + singles("gross", 5, 0, member="soft") + healthy(30, 1)
    found = tables({"ours": cases, "naive": [Answered(c.label, None, "none") for c in cases]}, "")
    assert "| `alpha` |  | 19/20 | 5/5 |  | 0/25 |" in found["classes"]
    assert "| `none` |  |  |  | 30/31 | 0/31 |" in found["classes"]
    assert "| `alpha` | soft | 5/5 | 0/5 | 0/5 |" in found["members"]
    assert "- alpha taken for gamma: 1" in found["notes"]
