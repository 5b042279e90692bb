# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_deflection"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"], "networks": ["torch"]},
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Predicts how far the arm bends under load.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "collect = galen_deflection.executables:collect",
            "collection_node = galen_deflection.executables:collection_node",
            "deflection_node = galen_deflection.executables:deflection_node",
            "evaluate = galen_deflection.executables:evaluate",
            "train = galen_deflection.executables:train",
        ]
    },
)
