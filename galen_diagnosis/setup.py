# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_diagnosis"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.json", "*.html", "specifications/*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Where arm and model differ, which effect causes it, how far the gap shrinks.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "diagnose = galen_diagnosis.executables:diagnose",
            "blind_check = galen_diagnosis.executables:blind_check",
        ]
    },
)
