"""ament_python package; fgloc itself is installed by pip into the interpreter that runs colcon."""

from glob import glob

from setuptools import setup

NAME = "fgloc_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", glob(f"{folder}/*")) for folder in ("launch", "config", "systemd")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    license="BSD-3-Clause",
    description="Lifecycle node that localizes a wheeled robot with fgloc",
    entry_points={"console_scripts": [f"fgloc = {NAME}.node:main"]},
)
