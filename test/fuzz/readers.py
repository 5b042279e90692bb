# SPDX-License-Identifier: Apache-2.0
"""Every reader of files and messages, and what it promises whatever the bytes are.

Either it reads something that holds together (finite numbers, the right shapes, what is written
again is read the same), or it raises a GalenError whose message is one line that names the file.
The property tests (test_bad_input.py) and the fuzzer (run.py) hold all readers to it.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
for _package in ("galen_bags", "galen_deflection"):
    sys.path.append(str(ROOT / _package / "test"))  # their made-up bags and models

from bags_samples import (  # noqa: E402  after the paths
    JOINT_STATE,
    WRENCH,
    Sample,
    StoragePlugin,
    arm_samples,
    cdr,
    header,
    joint_state,
    mcap_of,
    wrench,
    write_rosbag2,
)
from deflection_made_model import made_model  # noqa: E402
from galen_bags.arrays.arm_recording import (  # noqa: E402
    ArmTopics,
    Decoder,
    read_arm,
)
from galen_bags.arrays.joint_table import JointColumns, read_joint_run  # noqa: E402
from galen_bags.arrays.tables import (  # noqa: E402
    read_motion,
    read_orientations,
    read_table,
    read_wrenches,
)
from galen_bags.convert import build_parser, convert  # noqa: E402
from galen_bags.formats.bag import open_bag  # noqa: E402
from galen_bags.formats.files import read_metadata  # noqa: E402
from galen_bags.formats.mcap_records import zstd  # noqa: E402
from galen_bags.formats.raw_block import pack  # noqa: E402
from galen_common.cdr import ImuWire, JointWire, WrenchWire  # noqa: E402
from galen_deflection.models.file import read_model, write_model  # noqa: E402
from galen_gravcomp.evaluate.drift_series import read_series  # noqa: E402
from galen_model.arm.galen import GALEN  # noqa: E402
from galen_model.errors import GalenError  # noqa: E402
from galen_model.files.calibration_file import (  # noqa: E402
    CalibrationFile,
    read_calibration,
    write_calibration,
    zeroed_at,
)
from galen_model.files.calibration_store import CalibrationStore  # noqa: E402
from galen_model.files.comparison import compare_calibrations  # noqa: E402
from galen_model.json_fields import FieldError  # noqa: E402
from galen_model.load.model import LoadEstimate  # noqa: E402

from galen_validation.blind.answers import read_answer  # noqa: E402

LONGEST_MESSAGE = 2000
"""Letters, beside the path; more of a hostile file must not get into a log."""

POSES = np.array([[0.0, 0.0], [1.5, -1.0], [-1.5, 0.9]])
"""Roll and tilt, rad, at which what a file predicts must be finite."""

JOINTS = np.array([0.0, 0.0, 0.408, 0.0, 0.0])


@dataclass(frozen=True)
class Reader:
    """`use` reads a file and checks what it got; `names_file`: its errors name the file."""

    file_name: str
    seeds: Callable[[], list[bytes]]
    use: Callable[[Path], None]
    names_file: bool = True


def check(reader: Reader, data: bytes, folder: Path) -> bool:
    """Whether the bytes were read; AssertionError, or what should not get out, if it is wrong."""
    path = folder / reader.file_name
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # such as an overflow, which a user would see
            reader.use(path)
    except GalenError as error:
        told = str(error)
        assert not reader.names_file or path.name in told, f"does not name the file: {told}"
        rest = told.replace(str(folder), "")
        assert told.isprintable(), f"not one plain line: {told!r}"
        assert len(rest) < LONGEST_MESSAGE, f"{len(rest)} letters: {rest[:100]}"
        return False
    return True


# --- tools' files ---------------------------------------------------------------------------------


def a_tool(name: str = "file", mass_kg: float = 0.06) -> CalibrationFile:
    """A tool's file that is right."""
    return CalibrationFile(
        tool=name,
        load=LoadEstimate(mass_kg, np.array([0.055, 0.002, 0.045]), np.eye(4) * 1e-8),
        adapter=LoadEstimate(0.1, np.array([0.0, 0.0, 0.02]), np.eye(4) * 1e-8),
        tip_m=np.array([0.15, 0.0, 0.05]),
        rmse=np.full(6, 1e-3),
        poses_used=56,
        calibrated_at="2026-01-01T00:00:00+00:00",
        poses_rejected=("with the tool, pose 3: moved",),
        arm=GALEN,
        zeroing=zeroed_at(arm=GALEN),
    )


def _tool_contents() -> list[dict]:
    inertia = {
        "about_sensor_kg_m2": [1e-4, 2e-4, 2e-4, 0.0, 0.0, 0.0],
        "order": ["xx", "yy", "zz", "xy", "xz", "yz"],
        "covariance": (np.eye(6) * 1e-12).tolist(),
    }
    mounting = {
        "sensor_rotvec_rad": [0.01, 0.0, 0.0],
        "axis_gain": [0.0] * 6,
        "base_inclination_rad": {"about_x": 0.0, "about_y": 0.01},
        "joint_zero_rad": {"roll": 0.0, "tilt": 0.0},
        "covariance": (np.eye(13) * 1e-8).tolist(),
        "estimated": [],
    }
    whole = a_tool().to_json()
    return [whole, {**whole, "inertia": inertia}, {**whole, "mounting": mounting}]


def use_tool(path: Path) -> None:
    """Read, predict, compare, write, read again."""
    store = CalibrationStore(path.parent, arm=GALEN)
    entry = next(store.entries([path.stem]))
    tool = read_calibration(path, arm=GALEN)  # its error ends it
    if tool.tool == path.stem:
        assert entry.stored is not None and entry.stored.tool.to_json() == tool.to_json()
    assert tool.load.mass_kg > 0.0 and tool.adapter.mass_kg >= 0.0
    assert np.isfinite(tool.predict(POSES)).all()
    assert (
        compare_calibrations(tool, a_tool("other")).text
        if tool.sensor_frame == "ft_sensor"
        else True
    )
    again = path.with_name("again.json")
    write_calibration(again, tool)
    assert read_calibration(again, arm=GALEN).to_json() == tool.to_json()
    again.with_name("again.json.bak").unlink(missing_ok=True)
    again.unlink()


# --- models ---------------------------------------------------------------------------------------


def signed(data: bytes) -> bytes:
    """A model's JSON with the checksum that is right for it, where it is JSON at all.

    Else nothing but the checksum would ever be tried.
    """
    try:
        content = json.loads(data)
        rest = {name: value for name, value in content.items() if name != "sha256"}
        canonical = json.dumps(rest, sort_keys=True, separators=(",", ":"))
        return json.dumps(
            {**rest, "sha256": hashlib.sha256(canonical.encode()).hexdigest()}
        ).encode()
    except (ValueError, AttributeError, RecursionError, TypeError):
        return data


def _model_seeds() -> list[bytes]:
    return [
        json.dumps({"schema_version": 1, **made_model(hysteresis).to_json()}).encode()
        for hysteresis in (False, True)
    ]


def use_model(path: Path) -> None:
    """Read as it is and signed, predict, write, read again."""
    data = path.read_bytes()
    path.write_bytes(signed(data))
    model = read_model(path, arm=GALEN)
    stream = model.stream()
    for k in range(3):
        predicted = stream.step(k * 2_000_000, JOINTS, np.array([1.0, -2.0, 3.0, 0.1, 0.0, -0.1]))
        assert np.isfinite(predicted.mean).all() and np.isfinite(predicted.covariance).all()
    again = path.with_name("again.json")
    write_model(again, model)
    assert read_model(again, arm=GALEN).to_json() == model.to_json()
    again.with_name("again.json.bak").unlink(missing_ok=True)
    again.unlink()


# --- tables ---------------------------------------------------------------------------------------


def use_table(path: Path) -> None:
    """By every reader of tables; one that rejects leaves the others their turn."""
    rejected: GalenError | None = None
    columns = JointColumns(motor="gx", link="gy", torque="gz", t="t")
    readers = (
        partial(read_table, arm=GALEN),
        partial(read_table, wrench_frame="base", arm=GALEN),
        read_wrenches,
        partial(read_orientations, arm=GALEN),
    )
    for read in readers:
        try:
            found = read(path)
        except GalenError as error:
            rejected = error
            continue
        for part in found if isinstance(found, tuple) else (found,):
            _check_table(part)
    try:
        run = read_joint_run(path, columns)
        assert np.isfinite(run.lag).all() and run.step_s > 0.0
    except GalenError as error:
        rejected = rejected or error
    if rejected is not None:
        raise rejected


def _check_table(part: object) -> None:
    if isinstance(part, np.ndarray):
        assert np.isfinite(part).all()
    elif part is not None:
        assert part.wrench.shape == (len(part), 6) and part.gravity.shape == (len(part), 3)
        assert np.isfinite(part.wrench).all() and np.isfinite(part.gravity).all()
        assert np.allclose(np.linalg.norm(part.gravity, axis=1), 9.80665, rtol=0.03)
        if part.rotation is not None:
            products = part.rotation @ part.rotation.transpose(0, 2, 1)
            assert np.allclose(products, np.eye(3), atol=0.05)


def _table_seeds() -> list[bytes]:
    heads = (
        "t,fx,fy,fz,tx,ty,tz,gx,gy,gz,block",
        "t;fx;fy;fz;tx;ty;tz;qx;qy;qz;qw",
        "t fx fy fz tx ty tz roll tilt",
        "t,fx,fy,fz,tx,ty,tz,r11,r12,r13,r21,r22,r23,r31,r32,r33",
    )
    rows = (
        "0.1,1,2,3,.1,.2,.3,0,0,-9.81,a\n0.2,1,2,3,.1,.2,.3,0,0,-9.81,b",
        "0.1;1;2;3;.1;.2;.3;0;0;0;1\n0.2;1;2;3;.1;.2;.3;0;0;1;0",
        "0.1 1 2 3 .1 .2 .3 .5 .25\n0.2 1 2 3 .1 .2 .3 -.5 .25",
        "0.1,1,2,3,.1,.2,.3,1,0,0,0,1,0,0,0,1",
    )
    seeds = ["\n".join(pair).encode() for pair in zip(heads, rows, strict=True)]
    run = "t,gx,gy,gz\n" + "".join(f"{k / 50},{k},{k * 0.9 + k % 3},{k % 7}\n" for k in range(60))
    return [*seeds, run.encode()]


def use_convert(path: Path) -> None:
    """Into a bag, by `convert`; the bag is whole, or there is none."""
    bag = path.with_name("bag")
    options = ["--time-unit", "ms", "-o", str(bag)]
    rejected: GalenError | None = None
    for files in ([str(path)], ["--wrench", str(path), "--orientations", str(path)]):
        try:
            written = "\n".join(convert(build_parser().parse_args([*files, *options])))
        except GalenError as error:
            assert not bag.exists()
            rejected = error
            continue
        arm = read_arm(bag, arm=GALEN)
        assert f"joint_states: {len(arm.joints)} messages" in written
        assert f"wrench_raw: {len(arm.wrenches)} messages" in written
        assert np.isfinite(arm.joints).all() and np.isfinite(arm.wrenches).all()
        shutil.rmtree(bag)
    if rejected is not None:
        raise rejected


def use_motion(path: Path) -> None:
    """As `score_motion` and `drift` read tables, of wrenches, orientations and accelerations."""
    rejected: GalenError | None = None
    try:
        run = read_motion(path, path, path, 1.0, 9.80665, arm=GALEN)
        for part in (run.wrench_s, run.wrench, run.imu_s, run.specific, run.gravity_s, run.gravity):
            assert np.isfinite(part).all()
    except GalenError as error:
        rejected = error
    series = read_series([path], ArmTopics(), cell_s=10.0, arm=GALEN)
    assert series.samples > 0 and series.reading.shape[1] == 6
    if rejected is not None:
        raise rejected


def _motion_seeds() -> list[bytes]:
    head = b"t,fx,fy,fz,tx,ty,tz,gx,gy,gz,ax,ay,az\n"
    run = "".join(f"{k / 50},{k},2,3,.1,.2,.3,0,{k % 3},-9.81,0,{k % 2},-1\n" for k in range(20))
    hour = "".join(f"{k},{k % 7},2,3,1,2,3\n" for k in range(650))
    return [head + run.encode(), head[:19] + b"\n" + hour.encode()]


# --- diagnosis ------------------------------------------------------------------------------------


def use_answer(path: Path) -> None:
    """An answer of any tool to a recording of a blind set."""
    try:
        said = read_answer(path.parent, path.stem)
    except FieldError as error:
        raise GalenError(f"{path}: {error}") from error
    assert said.first in said.ranking and said.named >= set(said.causes)
    assert np.isfinite([*said.ranking.values()]).all()


def _answer_seeds() -> list[bytes]:
    cause = {"effect": "cable_drag", "parameters": {"x": 1.0}, "equivalent": ["base_shift"]}
    content = {
        "verdict": "identified",
        "ranking": [
            {"effect": "cable_drag", "probability": 0.9},
            {"effect": "none", "probability": 0.1},
        ],
        "causes": [cause],
    }
    return [json.dumps(content).encode()]


# --- bags -----------------------------------------------------------------------------------------


def use_bag(path: Path) -> None:
    """All its messages as bytes, then the arm's as numbers."""
    bag_path = path.parent if path.name == "metadata.yaml" else path
    with open_bag(bag_path) as bag:
        for block in bag.blocks([t.name for t in bag.topics.values() if t.encoding == "cdr"]):
            assert len(block) and (block.size >= 0).all()
            assert (block.start + block.size <= len(block.data)).all()
        for problem in bag.problems:
            assert "\n" not in problem and len(problem) < LONGEST_MESSAGE
    arm = read_arm(bag_path, arm=GALEN)
    assert arm.joints.shape == (len(arm.joint_stamp_ns), 5) and len(arm.joints)
    assert arm.wrenches.shape == (len(arm.wrench_stamp_ns), 6) and len(arm.wrenches)


def use_metadata(path: Path) -> None:
    """A directory whose metadata.yaml is this; its one file is whole."""
    (path.parent / "bag_0.mcap").write_bytes(_MCAP)
    found = read_metadata(path.parent)
    assert found.start_ns is None or isinstance(found.start_ns, int)
    use_bag(path)


_SAMPLES = arm_samples(6)
_MCAP = mcap_of(_SAMPLES, chunk_of=5)


def _mcap_seeds() -> list[bytes]:
    return [
        mcap_of(_SAMPLES, compression, chunk_of=chunk_of, summary=summary, crc=False)
        for compression, chunk_of, summary in (
            ("", 5, True), ("", None, False), ("zstd", 5, True), ("lz4", 5, False),
        )
    ]  # fmt: skip


def _in_folder(write: Callable[[Path], list[bytes]]) -> list[bytes]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return write(Path(folder))


def _db3_seeds() -> list[bytes]:
    def write(folder: Path) -> list[bytes]:
        path = write_rosbag2(folder / "bag", _SAMPLES, StoragePlugin.SQLITE3)
        return [file.read_bytes() for file in path.glob("*.db3")]

    return _in_folder(write)


def _metadata_seeds() -> list[bytes]:
    def write(folder: Path) -> list[bytes]:
        path = write_rosbag2(folder / "bag", _SAMPLES)
        return [(path / "metadata.yaml").read_bytes().replace(b"bag.mcap", b"bag_0.mcap")]

    return _in_folder(write)


# --- messages -------------------------------------------------------------------------------------


def use_messages(path: Path) -> None:
    """Bytes as a publisher may send them, to all that read them live and from bags."""
    data = path.read_bytes()
    rejected: GalenError | None = None
    live: dict[str, object] = {}
    for name, read in (
        ("wrench", WrenchWire().read),
        ("imu", ImuWire().read),
        ("joints", JointWire(GALEN.joint_names[3:]).read),
    ):
        try:
            live[name] = read(data)
        except GalenError as error:
            rejected = error
    if "wrench" in live:
        raw = live["wrench"]
        written = raw.with_wrench(np.arange(6.0))
        again = WrenchWire().read(written)
        assert len(written) == len(data) and again.wrench == tuple(range(6))
        assert (again.stamp_ns, again.frame_id) == (raw.stamp_ns, raw.frame_id)
    if "imu" in live:
        assert len(live["imu"][1]) == len(live["imu"][2]) == 3
    block = pack([0], [0], [data])
    decoders = {
        "wrench": Decoder(WRENCH),
        "joints": Decoder(JOINT_STATE, GALEN.joint_names[3:], required=GALEN.joint_names[3:]),
    }
    for name, decoder in decoders.items():
        samples = decoder.decode(block, np.zeros(1, dtype=int))
        assert bool(samples.bad) == (name not in live), f"{name}: {samples.bad}"
        if name == "joints" and name in live:
            np.testing.assert_array_equal(samples.values[0, :2], live[name][1])
            assert samples.stamp_ns[0] == live[name][0]
        elif name in live:
            np.testing.assert_array_equal(samples.values[0], live[name].wrench)
            assert samples.stamp_ns[0] == live[name].stamp_ns
    if rejected is not None:
        raise rejected


def _message_seeds() -> list[bytes]:
    head = header(_SAMPLES[0].log_time_ns, "ft_sensor")
    joints = joint_state(head, GALEN.joint_names, JOINTS, JOINTS)
    messages = [cdr(wrench(head, range(6))), cdr(joints), cdr(joints, little_endian=False)]
    return [*messages, messages[0] + bytes(37 * 8)]  # as long as an Imu


def samples_file(samples: list[Sample]) -> bytes:
    """A bag of these, for tests that make their own messages."""
    return mcap_of(samples)


READERS = {
    "tool_file": Reader(
        "file.json", lambda: [json.dumps(c).encode() for c in _tool_contents()], use_tool
    ),
    "model_json": Reader("model.json", _model_seeds, use_model),
    "table": Reader("table.csv", _table_seeds, use_table),
    "convert": Reader("table.csv", _table_seeds, use_convert),
    "motion": Reader("table.csv", _motion_seeds, use_motion),
    "answer": Reader("diagnosis.json", _answer_seeds, use_answer),
    "mcap": Reader("bag.mcap", _mcap_seeds, use_bag),
    "mcap_zstd": Reader("bag.mcap.zstd", lambda: [zstd.compress(_MCAP)], use_bag),
    "db3": Reader("bag.db3", _db3_seeds, use_bag),
    "metadata": Reader("metadata.yaml", _metadata_seeds, use_metadata, names_file=False),
    "messages": Reader("message", _message_seeds, use_messages, names_file=False),
}
