"""The deflection as a managed node, over its own services."""

import pytest
from deflection_made_model import made_model
from galen_deflection.models.file import write_model
from galen_ros.node.diagnostics import Level
from galen_ros.node.testing import Harness, Lifecycle
from test_deflection_node import Bench


@pytest.fixture
def bench(tmp_path):
    write_model(tmp_path / "good.json", made_model())
    write_model(tmp_path / "softer.json", made_model(softer=1.5))
    (tmp_path / "torn.json").write_text((tmp_path / "good.json").read_text()[:700])
    with Harness() as harness:
        bench = Bench(harness, tmp_path / "good.json")
        bench.folder = tmp_path
        bench.life = Lifecycle(harness, bench.arm, "deflection")
        yield bench


def connected(bench):
    publishers = (bench.arm.joints_publisher, bench.arm.wrench_publisher)
    return all(publisher.get_subscription_count() for publisher in publishers)


def says(bench):
    return {item.key: item.value for item in bench.arm.reports[-1].values}


def test_nothing_goes_out_while_it_is_inactive_and_the_loads_are_forgotten(bench):
    bench.step()
    bench.outputs(1)
    assert bench.life.go("deactivate") and bench.life.state == "inactive"
    bench.state("inactive", Level.WARN)
    bench.harness.wait_for(lambda: not connected(bench), 20.0, "the subscriptions to go")
    for _ in range(20):
        bench.step()
    assert bench.life.go("activate")
    bench.harness.wait_for(lambda: connected(bench), 20.0, "the subscriptions")
    stamp = bench.step()
    assert [row[0] for row in bench.outputs(2)][1:] == [stamp]
    bench.harness.wait_for(lambda: says(bench)["lifecycle"] == "active", 20.0, "a report")
    assert says(bench)["model_file"].endswith("good.json")
    assert says(bench)["last_forgotten"] == "the node was deactivated"


def test_it_is_configured_anew_with_another_model(bench):
    push = bench.step()
    first = bench.outputs(1)[0][2]
    assert "'joint_names' can't be set while the node is active" in bench.life.set(
        joint_names=["a"]
    )
    assert bench.life.go("deactivate", "cleanup")
    # Nobody reads it now; configuring does.
    assert not bench.life.set(model_file=str(bench.folder / "torn.json"))
    assert not bench.life.go("configure") and bench.life.state == "unconfigured"

    def failed():
        said = bench.arm.reports[-1]
        return said.level == bytes([Level.ERROR]) and "torn.json" in said.message

    bench.harness.wait_for(failed, 20.0, "the error on /diagnostics")
    assert not bench.life.set(model_file=str(bench.folder / "softer.json"))
    assert bench.life.go("configure", "activate")
    bench.harness.wait_for(lambda: connected(bench), 20.0, "the subscriptions")
    bench.harness.wait_for(bench.arm.inputs[0].get_publisher_count, 20.0, "the publisher")
    assert bench.step() > push
    assert bench.outputs(2)[1][2][0] == pytest.approx(1.5 * first[0], rel=0.2)
