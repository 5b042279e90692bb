# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_panel"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.css", "*.js"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=["setuptools", "nicegui", "starlette", "uvicorn"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="The operator's panel in the browser.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["panel = galen_panel.executables:panel"]},
)
