import importlib.util

import numpy as np
import pytest
from galen_diagnosis.blind.baselines.answers import NAIVE_BIC, RMSE_DROP, Rest, simple_answers
from galen_diagnosis.blind.baselines.features import FEATURES, features
from galen_diagnosis.blind.baselines.network import NetworkError, lacking, read_network, train
from galen_diagnosis.blind.parsed_answer import said_from_json
from galen_diagnosis.blind.plant.case import Case, generate
from galen_diagnosis.blind.scoring.oracle import oracle_closed
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.observation.rows import BAGS, CHANNELS, Rows

torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="needs PyTorch (make networks)"
)


def rows_of(random, n=400, bags=("sweep", "motion")):
    channel = np.tile(np.arange(6), n * len(bags))
    bag = np.repeat([BAGS.index(name) for name in bags], 6 * n)
    size = len(channel)
    at_s = np.tile(np.repeat(np.linspace(0.0, 100.0, n), 6), len(bags))
    joints = np.zeros((size, 5))
    joints[:, 3] = np.sin(0.31 * at_s)
    joints[:, 4] = 0.8 * np.sin(0.17 * at_s + 0.4)
    rate = np.zeros((size, 5))
    rate[:, 3], rate[:, 4] = np.cos(0.31 * at_s), np.cos(0.17 * at_s + 0.4)
    zero = np.zeros(size, dtype=int)
    return Rows(
        channel=channel, bag=bag, regime=zero, bag_s=at_s, session_s=at_s + 150.0 * bag,
        pose=zero, block=zero, fold=zero, joints=joints, rate=rate,
        samples=zero + 1, scale=np.ones(size),
    )  # fmt: skip


def test_leftover_is_that_of_a_least_squares_fit():
    random = np.random.default_rng(0)
    unknowns, columns = random.normal(size=(300, 4)), random.normal(size=(300, 3))
    residual = random.normal(size=300) + columns @ [0.5, 0.0, -0.3]
    rest = Rest(residual, unknowns)
    both = np.column_stack([unknowns, columns])
    expected = np.linalg.lstsq(both, residual, rcond=None)[1][0]
    left, k = rest.left_by(columns)
    assert (left, k) == (pytest.approx(expected), 3)
    alone = np.linalg.lstsq(unknowns, residual, rcond=None)[1][0]
    assert rest.sum_of_squares == pytest.approx(alone)
    # what the unknowns explain already takes nothing away, nor does a column of zeros
    assert rest.left_by(unknowns[:, :2])[0] == pytest.approx(rest.sum_of_squares)
    assert rest.left_by(np.zeros((300, 2)))[0] == pytest.approx(rest.sum_of_squares)


def test_the_simple_methods_answer_as_they_are_known_to():
    n = 1000
    found = simple_answers(n, 1000.0, {"gain": (995.0, 1), "wide": (960.0, 60)})
    drop, bic = (said_from_json("r", found[name]) for name in (RMSE_DROP, NAIVE_BIC))
    assert drop.first == "wide" and drop.verdict == "identified"
    # 60 parameters cost 414, and 1 costs 6.9; neither gains as much: none it is.
    assert bic.first == "none" and bic.verdict == "none" and not bic.causes
    assert sum(bic.ranking.values()) == pytest.approx(1.0)
    odds = 0.5 * (n * np.log(1000.0 / 995.0) - np.log(n))
    assert bic.ranking["gain"] / bic.ranking["none"] == pytest.approx(np.exp(odds))
    clear = simple_answers(n, 1000.0, {"gain": (900.0, 1), "wide": (880.0, 60)})
    assert said_from_json("r", clear[NAIVE_BIC]).first == "gain"
    quiet = said_from_json("r", simple_answers(n, 1000.0, {"gain": (999.0, 1)})[RMSE_DROP])
    assert quiet.first == "none"


def test_features_of_noise_are_small_and_of_a_course_large():
    random = np.random.default_rng(1)
    rows = rows_of(random)
    noise = random.normal(size=len(rows))
    plain = features(rows, noise)
    assert plain.shape == (FEATURES,)
    there = plain != 0.0
    assert there.sum() == FEATURES * 12 // (6 + 6 + len(CHANNELS))
    assert np.abs(plain[there]).mean() < 0.8 and np.abs(plain).max() < np.log1p(5.5)
    in_fy = (rows.channel == 1) & (rows.bag == BAGS.index("sweep"))
    moved = features(rows, noise + 0.5 * in_fy * np.sin(rows.joints[:, 4]))
    changed = np.flatnonzero(np.abs(moved - plain) > 0.05)
    per_block = FEATURES // (6 + 6 + len(CHANNELS))
    assert len(changed) and set(changed // per_block) == {1}
    # the projection on the course of sin tilt, the seventh, grows by that course's length
    course = np.sin(rows.joints[in_fy, 4])
    before, after = (np.sign(f) * np.expm1(np.abs(f)) for f in (plain, moved))
    expected = 0.5 * np.linalg.norm(course - course.mean())
    assert (after - before)[per_block + 6] == pytest.approx(expected)


def examples(random, n):
    names = ("none", "alpha", "unknown")
    truth = [names[number % 3] for number in range(n)]
    x = random.normal(size=(n, 12))
    x[:, 3] += [3.0 * (name == "alpha") for name in truth]
    x[:, 7] += [4.0 * (name == "unknown") for name in truth]
    return names, truth, x


@pytest.mark.slow
@torch
def test_the_network_learns_and_comes_back_from_its_file(tmp_path):
    random = np.random.default_rng(2)
    names, truth, x = examples(random, 240)
    network, right = train(x, truth, names, hidden=8, iterations=150)
    assert right["held_out"] > 0.8
    path = tmp_path / "network.safetensors"
    assert "train_baseline" in lacking(path)
    network.write(path)
    again = read_network(path)
    assert lacking(path) == ""
    _, other_truth, fresh = examples(random, 120)
    said = [again.probabilities(row) for row in fresh]
    assert said == [network.probabilities(row) for row in fresh]
    assert all(sum(p.values()) == pytest.approx(1.0) for p in said)
    hits = [max(p, key=p.get) == name for p, name in zip(said, other_truth, strict=True)]
    assert np.mean(hits) > 0.8
    # with the answers dealt at random there is nothing to learn
    _, chance = train(x, list(random.permutation(truth)), names, hidden=8, iterations=150)
    assert chance["held_out"] < 0.6
    with pytest.raises(NetworkError, match="no recording of beta"):
        train(x, truth, (*names, "beta"))
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(NetworkError, match="no network"):
        read_network(path)


def test_the_oracle_closes_what_the_cause_does_and_no_more(tmp_path):
    healthy, twin, sick = (tmp_path / name for name in ("healthy", "twin", "sick"))
    bags = ("sweep",)
    generate(Case(31, "none", bags=bags), healthy)
    generate(Case(31, "single", ("tilt_zero_offset",), "gross", bags), sick, twin)
    # The same arm, the same noise: the twin is what a healthy recording of this seed is.
    one, other = (read_recording(path).bags["sweep"] for path in (healthy, twin))
    assert np.array_equal(one.wrenches, other.wrenches)
    assert oracle_closed(sick, twin) == pytest.approx(1.0, abs=0.02)
    assert oracle_closed(sick, sick) == pytest.approx(0.0, abs=0.02)
    closed = oracle_closed(healthy, twin)
    assert closed is None or closed == pytest.approx(0.0, abs=1e-9)
