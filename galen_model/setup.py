# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_model"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    package_data={"": ["py.typed"]},
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Kinematics, wrench algebra, load model and calibration files, free of ROS.",
    license="Apache-2.0",
    entry_points={"console_scripts": []},
)
