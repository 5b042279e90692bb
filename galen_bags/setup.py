# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package_name = "galen_bags"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "apsw",
        "backports.zstd; python_version < '3.14'",
        "lz4",
        "rosbags",
    ],
    extras_require={
        "test": ["pytest"],
        "archive": ["dask", "distributed", "fsspec", "pyarrow", "s3fs"],
    },
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Bags in and out: read into arrays, record, play, work through many.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "convert = galen_bags.executables:convert",
            "record = galen_bags.executables:record",
            "play = galen_bags.executables:play",
        ]
    },
)
