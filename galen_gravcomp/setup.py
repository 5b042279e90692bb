# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_gravcomp"

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
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Subtracts the tool's weight from the wrench, live and on recordings.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "gravcomp_node = galen_gravcomp.executables:gravcomp_node",
            "evaluate = galen_gravcomp.executables:evaluate",
            "tools = galen_gravcomp.executables:tools",
        ]
    },
)
