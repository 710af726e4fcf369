"""The ROS package, as colcon builds it with the distribution's setuptools, which may be old."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

PACKAGE = "mqtt_appliance"
MANIFEST = ElementTree.parse(Path(__file__).resolve().parent / "package.xml")

setup(
    name=PACKAGE,
    version=MANIFEST.findtext("version"),
    packages=[PACKAGE],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (
            f"share/{PACKAGE}/launch",
            ["launch/appliance.launch.py", "launch/appliance.launch.yaml"],
        ),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The authors of ros-mqtt-appliance",
    maintainer_email="maintainers@ros-mqtt-appliance.invalid",
    description="Starts the MQTT appliance as a node: by ros2 run and ros2 launch",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"appliance = {PACKAGE}.start:main"]},
)
