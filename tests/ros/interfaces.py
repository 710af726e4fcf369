"""Builds an interface package, as colcon would, with the generators that the ROS wheels bring:

python interfaces.py SOURCE PREFIX NAME DEPENDENCY…

SOURCE has `msg/*.msg`; PREFIX is what a workspace's `install` folder is. It takes a C++ compiler.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_generator_type_description.cli import HashTypeDescription
from rosidl_typesupport_c.cli import GenerateCTypesupport
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

#: Where the wheels are installed.
ROS = Path(sys.prefix)

#: The libraries that a package has of its own.
KINDS = (
    *("generator_c", "generator_py", "typesupport_c", "typesupport_fastrtps_c"),
    "typesupport_introspection_c",
)
LIBRARIES = (
    *("rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c"),
    *("rosidl_typesupport_fastrtps_cpp", "rosidl_typesupport_introspection_c", "fastcdr"),
)
#: The kinds of type support, which are looked for by the names of their libraries, and their files.
SUPPORTS = {
    "rosidl_typesupport_fastrtps_c": "detail/*__type_support_c.cpp",
    "rosidl_typesupport_introspection_c": "detail/*__type_support.c",
}


def build(source: Path, prefix: Path, name: str, dependencies: list[str]) -> None:
    share = prefix / "share" / name
    (share / "msg").mkdir(parents=True)
    definitions = sorted(source.glob("msg/*.msg"))
    for definition in definitions:
        convert_msg_to_idl(source, name, definition.relative_to(source), share / "msg")
        shutil.copy(definition, share / "msg")
    index = prefix / "share/ament_index/resource_index/rosidl_interfaces"
    index.mkdir(parents=True)
    (index / name).write_text("".join(f"msg/{path.name}\n" for path in definitions))

    site = prefix / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    package = site / name
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    files = [f"{share}:msg/{path.stem}.idl" for path in definitions]
    seen = [str(ROS / "share" / dependency) for dependency in dependencies]
    seen.append(str(prefix / "share" / name))
    hashes = HashTypeDescription("").generate_type_hashes(name, files, seen, package)
    for description in package.glob("msg/*.json"):
        shutil.copy(description, share / "msg")
    GenerateC("").generate(name, files, seen, package, hashes)
    GenerateCTypesupport("", typesupport_implementations=[*SUPPORTS]).generate(
        name, files, seen, package
    )
    GenerateFastRTPSCTypesupport("").generate(name, files, seen, package)
    GenerateIntrospectionCTypesupport("").generate(name, files, seen, package)
    GeneratePython("", typesupport_implementations=["rosidl_typesupport_c"]).generate(
        name, files, seen, package
    )
    compile_all(site, package, dependencies)


def compile_all(site: Path, package: Path, dependencies: list[str]) -> None:
    includes = [site, ROS / "include", sysconfig.get_paths()["include"], np.get_include()]
    includes += [path for path in (ROS / "include").iterdir() if path.is_dir()]
    flags = ["-O0", "-w", "-fPIC", *(f"-I{path}" for path in includes)]

    def run(path: Path) -> None:
        compiler = "gcc" if path.suffix == ".c" else "g++"
        subprocess.run([compiler, *flags, "-c", path, "-o", f"{path}.o"], check=True)

    sources = {*site.rglob("*.c"), *site.rglob("*.cpp")}
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, sources))
    libraries = [f"-l{each}__rosidl_{kind}" for each in dependencies for kind in KINDS]
    libraries += [f"-l{name}" for name in LIBRARIES]

    def link(library: Path, sources: set[Path], *more: str) -> None:
        objects = [f"{path}.o" for path in sources]
        options = ["-shared", f"-Wl,-soname,{library.name}", "-o", library, *objects, *more]
        subprocess.run(["g++", *options, f"-L{ROS / 'lib'}", *libraries], check=True)

    # Each is in memory, under its name, when the extension is: nothing need say where it lies.
    supports = []
    for kind, pattern in SUPPORTS.items():
        its = set(package.rglob(pattern))
        sources -= its
        supports.append(package / f"lib{package.name}__{kind}.so")
        link(supports[-1], its)
    extension = package / f"{package.name}_s__rosidl_typesupport_c.so"
    link(extension, sources, "-Wl,--no-as-needed,-rpath,$ORIGIN", *map(str, supports))


if __name__ == "__main__":
    os.environ["AMENT_PREFIX_PATH"] = str(ROS)  # where the generators look for their templates
    build(Path(sys.argv[1]).absolute(), Path(sys.argv[2]).absolute(), sys.argv[3], sys.argv[4:])
