"""Imports every module of the appliance, and prints those that cannot be."""

import importlib
import pkgutil

import appliance

#: What only ROS or an extra brings along.
OPTIONAL = {"numpy", "rclpy"}

for module in pkgutil.walk_packages(appliance.__path__, "appliance."):
    try:
        importlib.import_module(module.name)
    except Exception as error:
        if getattr(error, "name", None) not in OPTIONAL:
            print(module.name, type(error).__name__, error)
