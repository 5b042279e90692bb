# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package_name = "galen_bringup"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
        ("share/" + package_name + "/launch", glob("launch/*.launch.py")),
        ("share/" + package_name + "/urdf", glob("urdf/*.urdf")),
        ("share/" + package_name + "/config", glob("config/*.*")),
        ("share/" + package_name + "/config/sros2", glob("config/sros2/*.xml")),
        ("share/" + package_name + "/config/sros2/common", glob("config/sros2/common/*.xml")),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Launch files, configuration and the demonstration of the Galen suite.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "demo = galen_bringup.executables:demo",
            "preflight = galen_bringup.executables:preflight",
        ]
    },
)
