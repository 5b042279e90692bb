# SPDX-License-Identifier: Apache-2.0
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
    with Harness() as harness:
        bench = Bench(harness, tmp_path / "good.json")
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
