# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_calibration_behavior"
run = f"{package_name}.executables"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["*.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Sweeps the arm over still poses and writes the tool's file, as a ROS action.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"calibration_node = {run}:calibration_node",
            f"calibrate = {run}:calibrate",
            f"check = {run}:check",
            f"calibrate_from_bag = {run}:calibrate_from_bag",
        ]
    },
)
