# SPDX-License-Identifier: Apache-2.0
"""Names from users, files and messages never become paths unchecked.

Every place where a name makes a path is here, or where its row says:

    tool of ~/set_tool, ~/get_tool, ~/compare_tools, ~/rename_tool, ~/remove_tool, ~/revert_tool,
      check_tool, `tools`                  CalibrationStore: check_tool_name, no link  here
    tool of calibrate_tool, `calibrate*`   calibration_path                                  here
    tool in a tool's file                  check_tool_name                            test_bad_input
    tool of the driver's attach_tool       check_tool_name                            test_sim_node
    name of a collection                   CollectionFolder: check_tool_name          here
    files that metadata.yaml lists         their last part only                       here
    kind of a model                        a row of a table, never a path             here
    name of a recording                    its directory's; escaped in reports        test_report
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from bad_bytes import TEXTS
from fuzz.readers import READERS, a_tool, check, signed
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_deflection.ros.recorder import CollectionFolder
from galen_gravcomp.ros.tool_services import error_code
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_file import calibration_path, check_tool_name, write_calibration
from galen_model.files.calibration_store import CalibrationStore
from hypothesis import example, given, settings
from hypothesis import strategies as st

from galen_msgs.srv import GetTool, RemoveTool, RenameTool, RevertTool, SetTool

ALLOWED = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")
NAMES = st.text(max_size=70) | st.sampled_from(TEXTS) | st.text(sorted(ALLOWED) + ["/", "."])


def is_name(text: str) -> bool:
    return 1 <= len(text) <= 64 and set(text) <= ALLOWED


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(NAMES)
@example("a\n")
@example("pointer\0")
@example("x" * 64)
def test_a_name_is_letters_digits_dashes_and_nothing_else(text: str) -> None:
    if is_name(text):
        assert calibration_path("/tools", text) == Path(f"/tools/{text}.json")
        return
    with pytest.raises(ToolNameError) as rejected:
        check_tool_name(text)
    assert str(rejected.value).isprintable() and len(str(rejected.value)) < 200


def tree(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def test_no_request_with_a_strange_name_changes_anything(tmp_path: Path) -> None:
    """As the services call it; what is beside the tools is looked at as well."""
    store = CalibrationStore(tmp_path / "robot" / "tools", arm=GALEN)
    write_calibration(calibration_path(store.directory, "pointer"), a_tool("pointer"))
    (tmp_path / "robot" / "x.json").write_bytes((store.directory / "pointer.json").read_bytes())
    (tmp_path / "x.json").write_text("outside")
    before = tree(tmp_path)
    calls: list[tuple[type, Callable[[str], object]]] = [
        (SetTool.Response, store.read),
        (GetTool.Response, store.read),
        (RemoveTool.Response, store.remove),
        (RenameTool.Response, lambda name: store.rename(name, "new")),
        (RenameTool.Response, lambda name: store.rename("pointer", name)),
        (SetTool.Response, lambda name: calibration_path(store.directory, name)),
        (SetTool.Response, lambda name: CollectionFolder(tmp_path / "recordings", name)),
        (RemoveTool.Response, store.restore),
        (RevertTool.Response, store.revert),
    ]

    @settings(max_examples=60, deadline=None, derandomize=True, database=None)
    @given(NAMES.filter(lambda name: not is_name(name)))
    def rejected(name: str) -> None:
        for response, call in calls:
            with pytest.raises(ToolNameError) as error:
                call(name)
            code = error_code(response, error.value, "INVALID_FILE")
            assert code == response.INVALID_NAME
            assert str(error.value).encode() and len(str(error.value)) < 200
        assert tree(tmp_path) == before

    rejected()
    with pytest.raises(CalibrationFileError) as absent:
        store.read("absent")
    assert error_code(GetTool.Response, absent.value, "") == GetTool.Response.NOT_FOUND


@pytest.mark.parametrize("name", ["../other/bag.mcap", "/etc/passwd", "..", "link.mcap/../x"])
def test_a_bag_s_metadata_leads_nowhere_else(name: str, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "bag.mcap").write_bytes(READERS["mcap"].seeds()[0])
    (tmp_path / "bag").mkdir()
    content = f"rosbag2_bagfile_information:\n  relative_file_paths: ['{name}']\n"
    (tmp_path / "bag" / "metadata.yaml").write_text(content)
    with pytest.raises(BagError, match=r"missing|holds no bag"):
        open_bag(tmp_path / "bag")


@pytest.mark.parametrize("kind", ["../../etc/passwd", "os.system", "__class__", "x" * 1000])
def test_a_model_s_kind_is_no_path_and_no_module(kind: str, tmp_path: Path) -> None:
    content = {**json.loads(READERS["model_json"].seeds()[0]), "kind": kind}
    data = signed(json.dumps(content).encode())
    assert not check(READERS["model_json"], data, tmp_path)


def test_a_link_leads_no_service_out_of_the_directory(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path / "tools", arm=GALEN)
    write_calibration(calibration_path(store.directory, "pointer"), a_tool("pointer"))
    outside = tmp_path / "secret.json"
    outside.write_text(json.dumps(a_tool("secret").to_json()))
    (store.directory / "secret.json").symlink_to(outside)
    (store.directory / "up.json").symlink_to("../secret.json")
    before = tree(tmp_path)
    for name in ("secret", "up"):
        for call in (store.read, store.remove, lambda old: store.rename(old, "new")):
            with pytest.raises(GalenError, match="leads out of"):
                call(name)
    assert tree(tmp_path) == before
