from setuptools import find_packages, setup

package_name = "galen_calibration_behavior"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Sweeps the arm over still poses and writes the tool's file, as a ROS action.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "calibration_node = galen_calibration_behavior.node:main",
            "calibrate = galen_calibration_behavior.calibrate:main",
            "check_node = galen_calibration_behavior.check_node:main",
            "check = galen_calibration_behavior.check:main",
            "calibrate_from_bag = galen_calibration_behavior.calibrate_from_bag:main",
            "inertia_from_bag = galen_calibration_behavior.inertia_from_bag:main",
            "cable_from_bag = galen_calibration_behavior.cable_from_bag:main",
            "choose_poses = galen_calibration_behavior.choose_poses:main",
        ]
    },
)
