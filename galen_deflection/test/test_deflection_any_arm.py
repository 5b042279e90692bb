# SPDX-License-Identifier: Apache-2.0
"""Deflection of an arm that is not the Galen: a six-axis arm from its description."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from deflection_synthetic import FORCES_N, NOISE, script
from galen_common.goal.procedure import MoveTo
from galen_deflection.collection.plan import (
    CollectionParameters,
    ErrorCode,
    OutOfReachError,
    PlanError,
    make_plan,
)
from galen_deflection.collection.procedure import CollectionProcedure
from galen_deflection.evaluate import main as evaluate
from galen_deflection.measurement.samples import DeflectionError, DeflectionSamples
from galen_deflection.models.file import KINDS, read_model, write_model
from galen_deflection.models.springs import Springs
from galen_deflection.train import main as train
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import write_calibration, zeroed_at
from galen_model.play import PlayOperators
from push_bag import TOOL, Scene, write

URDF_FILE = Path(__file__).parents[2] / "galen_bringup" / "urdf" / "six_axis.urdf"
URDF = URDF_FILE.read_text()
ARM = read_arm(URDF)
TIP_M = np.array([0.02, -0.01, 0.12])
BENT = np.array([0.3, -1.2, 1.6, -0.9, -1.4, 0.5])
STIFFNESS = np.array([9e3, 8e3, 5e3, 2.5e3, 2e3, 1.5e3])
PLAN = make_plan(CollectionParameters(arm=ARM), TIP_M)
POSITIONS = BENT + PLAN.positions


class ByPinocchio:
    """Pose and Jacobian of the tip, the second method."""

    def __init__(self):
        self.model = pinocchio.buildModelFromXML(URDF)
        sensor = self.model.frames[self.model.getFrameId("ft_sensor")]
        placement = sensor.placement * pinocchio.SE3(np.eye(3), TIP_M)
        tip = pinocchio.Frame("tip", sensor.parentJoint, placement, pinocchio.FrameType.OP_FRAME)
        self.tip = self.model.addFrame(tip)
        self.data = self.model.createData()

    def jacobian(self, joints):
        world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return pinocchio.computeFrameJacobian(self.model, self.data, joints, self.tip, world)

    def rotation(self, joints):
        pinocchio.framesForwardKinematics(self.model, self.data, joints)
        return self.data.oMf[self.tip].rotation.copy()


def pushes(seed=0, stiffness=STIFFNESS, positions=POSITIONS, kept=0.0, axes=range(6)):
    """Samples of pushes in all directions; `kept`: what the elbow's play of 1 N.m adds to 1/k."""
    rng, second = np.random.default_rng(seed), ByPinocchio()
    at_tip = script(20.0, FORCES_N, (0.3, 0.8), axes)
    joints, wrench, deflection = [], [], []
    for place in positions:
        rotation, jacobian = second.rotation(place), second.jacobian(place)
        moments = at_tip @ jacobian
        turns = moments / stiffness
        turns[:, 2:3] += kept * PlayOperators(np.array([1.0])).run(moments[:, 2:3]).output
        force = at_tip[:, :3] @ rotation
        torque = at_tip[:, 3:] @ rotation + np.cross(TIP_M, force)
        joints.append(np.tile(place, (len(at_tip), 1)))
        wrench.append(np.hstack([force, torque]))
        deflection.append(turns @ jacobian.T)
    number = np.repeat(np.arange(len(positions)), len(at_tip))
    clean = np.concatenate(deflection)
    return DeflectionSamples(
        stamp_ns=np.arange(len(number)) * 50_000_000,
        segment=number,
        position=number,
        set_number=0 * number,
        joints=np.concatenate(joints),
        wrench=np.concatenate(wrench),
        deflection=clean + NOISE * rng.standard_normal(clean.shape),
        tip_m=TIP_M,
        noise=NOISE,
        arm=ARM,
    ), clean


def test_unknown_stiffnesses_of_all_joints_come_back_within_their_covariance():
    """Errors against the Cramer-Rao bound, which the samples' own design gives."""
    squares = []
    for seed in range(12):
        samples, _ = pushes(seed)
        model = KINDS["joint_stiffness"].fit(samples, None)
        assert [p.name for p in model.basis.parameters] == [f"1/k_{n}" for n in ARM.joint_names]
        assert model.unresolved == ()
        off = model.values - 1.0 / STIFFNESS
        assert np.all(np.abs(off) < 4.0 * model.std)
        squares.append(off @ np.linalg.solve(model.covariance, off))
    second = ByPinocchio()
    information = np.zeros((6, 6))
    for joints, wrench in zip(samples.joints[::7], samples.wrench[::7], strict=True):
        jacobian, rotation = second.jacobian(joints), second.rotation(joints)
        force = rotation @ wrench[:3]
        torque = rotation @ (wrench[3:] - np.cross(TIP_M, wrench[:3]))
        design = jacobian * (jacobian.T @ np.append(force, torque)) / NOISE[:, None]
        information += 7.0 * design.T @ design
    bound = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.all(model.std > 0.9 * bound) and np.all(model.std < 1.4 * bound)
    assert 37.0 < sum(squares) < 109.0  # chi-squared with 72 degrees of freedom, 99.7 %


@pytest.fixture(scope="module")
def model():
    return KINDS["joint_stiffness"].fit(pushes(1)[0], None)


def test_a_fitted_model_predicts_what_pinocchio_s_jacobian_says(model):
    elsewhere, clean = pushes(2, 1.0 / model.values, positions=[BENT + 0.1])
    np.testing.assert_allclose(model.predict(elsewhere).mean, clean, rtol=0, atol=1e-12)
    stiff = dict(zip(ARM.joint_names, 1.0 / model.values, strict=True))
    own = ARM.with_stiffness(stiff).deflection(elsewhere.joints[0], elsewhere.wrench[80], TIP_M)
    np.testing.assert_allclose(own, clean[80], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("arm", "spread"),
    [(GALEN, [0.1, 0.1, 0.1, np.pi, np.pi / 2]), (ARM, 2.5)],
    ids=["galen", "six"],
)
def test_one_pose_is_calculated_as_many_are(arm, spread):
    """Two ways to the same numbers, also where joints come again after others."""
    joints = arm.home + np.random.default_rng(3).uniform(-1, 1, (60, len(arm.joints))) * spread
    joints = joints[[0, 0, 1, 2, 2, 0, *range(60)]]
    one, many = Springs(TIP_M, arm), Springs(TIP_M, arm).geometry(joints)
    for k in range(len(joints)):
        for ours, theirs in zip(one.geometry(joints[k : k + 1])[:3], many[:3], strict=True):
            np.testing.assert_allclose(ours[0], theirs[k], rtol=0, atol=1e-13)


def test_hysteresis_of_one_joint_is_found_there():
    samples, clean = pushes(4, kept=1e-4)
    model = KINDS["joint_hysteresis"].fit(samples, None)
    weights = dict.fromkeys(ARM.joint_names, 0.0)
    for operator, weight in zip(model.basis.operators, model.values[6:], strict=True):
        weights[operator.place] += weight
    assert weights.pop("elbow") == pytest.approx(1e-4, rel=0.1)
    assert max(weights.values()) < 0.5e-4
    plain = KINDS["joint_stiffness"].fit(samples, None)
    off = [
        np.sqrt(np.mean(((m.predict(samples).mean - clean) / NOISE) ** 2)) for m in (model, plain)
    ]
    assert off[0] < 0.4 * off[1]


def test_a_joint_that_nothing_loads_stays_rigid_and_is_named():
    """Moments about the base's z at zero: only the joints whose axes are upright carry them."""
    samples, _ = pushes(5, positions=[np.zeros(6)], axes=[5])
    model = KINDS["joint_stiffness"].fit(samples, None)
    level = {"1/k_shoulder_lift", "1/k_elbow", "1/k_wrist_1", "1/k_wrist_3"}
    assert set(model.unresolved) == level
    names = [parameter.name for parameter in model.basis.parameters]
    assert all(abs(model.values[names.index(name)]) < 1e-15 for name in level)
    assert all(model.std[names.index(name)] == pytest.approx(5e-4) for name in level)


def test_a_model_s_file_names_its_arm_and_is_rejected_on_another(tmp_path, model):
    path = tmp_path / "six.json"
    write_model(path, model)
    np.testing.assert_array_equal(read_model(path, ARM).values, model.values)
    with pytest.raises(
        DeflectionError, match=r"arm 'six_axis' \(shoulder_pan, .*'galen' \(delta_x"
    ):
        read_model(path, arm=GALEN)
    other = replace(ARM, joints=(*ARM.joints[:5], replace(ARM.joints[5], name="wrist")))
    with pytest.raises(DeflectionError, match="not of 'six_axis'"):
        read_model(path, other)


def test_a_recording_of_another_arm_is_trained_on_and_evaluated(tmp_path, capsys):
    """From a bag with its calibration file, through both commands."""
    elastic = ARM.with_stiffness(dict(zip(ARM.joint_names, STIFFNESS, strict=True)))
    tool = replace(TOOL, arm=ARM, zeroing=zeroed_at(arm=ARM), made_on=None)
    scene = Scene(positions=POSITIONS, joint_zeros=np.zeros(6), arm=elastic, tool=tool)
    bag = write(tmp_path / "pushes", scene.topics(), arm=ARM)
    write_calibration(tmp_path / "tool.json", tool)
    urdf, of = ["--urdf", str(URDF_FILE)], [str(bag), "--tool", str(tmp_path / "tool.json")]
    model = tmp_path / "model.json"
    assert train([*of, "--kind", "joint_stiffness", "-o", str(model)]) == 1  # the Galen's, untold
    assert "six_axis" in capsys.readouterr().err
    assert train([*of, *urdf, "--kind", "joint_stiffness", "-o", str(model), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["parameters"]
    for parameter, stiffness in zip(told, STIFFNESS, strict=True):
        assert abs(parameter["value"] - 1.0 / stiffness) < 3.0 * parameter["std"], parameter["name"]
    assert evaluate([*of, *urdf, "--model", str(model), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["models"]["joint_stiffness"]
    assert found["rmse_over_noise_all"] < 1.1


def begun(joints):
    """A collection of the default positions that starts with the arm at these joints."""
    procedure = CollectionProcedure(CollectionParameters(arm=ARM), PLAN, TIP_M, True)
    procedure.start()
    procedure.on_wrench(1_000_000_000, np.zeros(6))
    procedure.on_joints(1_000_000_000, joints, np.zeros(6))
    procedure.on_recording()
    return procedure, procedure.take_commands()


def test_a_collection_of_another_arm_begins_where_it_stands():
    procedure, commands = begun(BENT)
    (move,) = [command for command in commands if isinstance(command, MoveTo)]
    np.testing.assert_allclose(move.joints, BENT)
    np.testing.assert_allclose(procedure.plan.positions - BENT, PLAN.positions)
    procedure, commands = begun(np.where(np.arange(6) == 2, np.nan, BENT))
    assert not any(isinstance(command, MoveTo) for command in commands)
    for tick in range(20):  # nothing shows that the arm has stopped
        procedure.on_wall(0.25 * tick)
    end = procedure.take_commands()[-1]
    assert end.error_code == ErrorCode.OUT_OF_REACH
    assert "elbow = nan" in end.error_msg


def test_positions_of_another_arm_lie_around_where_it_stands():
    settings = CollectionParameters(arm=ARM)
    begun = PLAN.begun_at(BENT, settings, TIP_M)
    np.testing.assert_allclose(begun.positions[0], BENT)
    assert begun.total == PLAN.total == 2 * 4 * 18
    moved = np.abs(begun.positions[1:] - BENT)
    assert np.allclose(moved, 0.15)
    assert np.linalg.matrix_rank(PLAN.positions) == 3
    assert len(make_plan(CollectionParameters(), TIP_M).positions[0]) == len(GALEN.joints)
    with pytest.raises(OutOfReachError, match=r"position 1: elbow = 2\.9 rad is"):
        PLAN.begun_at(np.where(np.arange(6) == 2, 2.9, BENT), settings, TIP_M)
    near = PLAN.begun_at(np.where(np.arange(6) == 2, -2.75, BENT), settings, TIP_M)
    assert np.all(near.positions >= ARM.lower)


def test_an_arm_that_would_hit_itself_on_its_way_is_not_moved():
    settings = CollectionParameters(arm=ARM)
    assert PLAN.begun_at(BENT, settings, TIP_M).warnings == ()
    folded = np.where(np.arange(6) == 2, 2.3, BENT)  # free itself
    with pytest.raises(OutOfReachError, match=r"position 2: on the way from position 1, the tool"):
        PLAN.begun_at(folded, settings, TIP_M)
    listed = replace(settings, positions=(*BENT, *(BENT + 0.1)))
    plan = make_plan(listed, TIP_M)
    assert plan.begun_at(BENT, listed, TIP_M).positions.shape == (2, 6)
    with pytest.raises(OutOfReachError, match=r"position 1: on the way from where the arm stands"):
        plan.begun_at(np.where(np.arange(6) == 2, 2.5, BENT), listed, TIP_M)
    with pytest.raises(PlanError, match="must be finite"):
        plan.begun_at(np.full(6, np.nan), listed, TIP_M)


def test_collisions_that_can_not_be_checked_reject_a_collection_unless_allowed():
    bare = read_arm(re.sub(r"<collision>.*?</collision>", "", URDF, flags=re.DOTALL))
    settings = CollectionParameters(arm=bare)
    with pytest.raises(PlanError, match=r"no collision shapes, so .* require_collision_shapes"):
        PLAN.begun_at(BENT, settings, TIP_M)
    settings = replace(settings, require_collision_shapes=False)
    procedure = CollectionProcedure(settings, PLAN, TIP_M, True)
    procedure.start()
    procedure.on_wrench(1_000_000_000, np.zeros(6))
    procedure.on_joints(1_000_000_000, BENT, np.zeros(6))
    end = procedure.finish(ErrorCode.CANCELED, "")
    assert end.warnings == (
        "collisions are not checked: the robot description has no collision shapes",
    )
