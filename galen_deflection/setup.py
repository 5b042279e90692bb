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
    zip_safe=True,
    maintainer="The Galen suite's authors",
    maintainer_email="galen@example.org",
    description="Predicts how far the arm bends under load.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "collect = galen_ros.executable:galen_deflection.collection.command.main",
            "collection_node = galen_ros.executable:galen_deflection.collection.node.main",
            "deflection_node = galen_ros.executable:galen_deflection.node.main",
            "evaluate = galen_ros.executable:galen_deflection.evaluate.main",
            "train = galen_ros.executable:galen_deflection.train.main",
        ]
    },
)
