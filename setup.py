"""Declares the package to pip and to colcon; package.xml declares it to rosdep and colcon."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "bnirl_ros"
# A symlinked colcon build runs a link to this file in a folder that has no README.
README = Path(__file__).resolve().parent / "README.md"
SHARED_FOLDERS = ("launch", "config", "rviz", "foxglove", "bags", "msg_schemas", "policies")

# The lower bounds of what has a rosdep key are the versions of Ubuntu 24.04, on which ROS 2 Jazzy
# runs: a colcon build there takes those.
REQUIREMENTS = [
    "lz4>=4.0",
    "matplotlib>=3.6",
    "mcap>=1.5",
    "numba>=0.58",
    "numpy>=1.26",
    "pillow>=10.2",
    "pytransform3d>=3.17",  # Frames that tf joins, where there is no tf2.
    "pyyaml>=6.0",
    "rich>=13.7",
    "rosbags>=0.10.8",  # Codes messages as CDR and knows their type hashes, without ROS.
    "scipy>=1.11",
    "zstandard>=0.22",
]

EXTRAS = {
    # The fastest of the others who solve such MDPs, to compare with.
    "benchmark": [
        "quantecon>=0.7",
    ],
    # libFuzzer for Python, Google's: looks for input that reaches further code.
    "campaigns": [
        "atheris>=3.0",
    ],
    # A cluster to infer on, of which `bnirl infer --scheduler` is a client.
    "dask": [
        "distributed>=2024.1",
    ],
    # What the algorithms need that the paper compares with, and nothing else does.
    "paper": [
        "clarabel>=0.9",  # Quadratic programs with cones; Apache-2.0, wheels for any Python 3.
    ],
    # The real rclpy from wheels, for machines without a ROS installation. The middleware has to be
    # named: the other two do not bring it, and rclpy does not import without one.
    "ros": [
        "ros-jazzy-common-interfaces>=5.3",
        "ros-jazzy-rclpy>=7.1",
        "ros-jazzy-rmw-fastrtps-cpp>=8.4",
    ],
    "test": [
        "arviz-stats>=0.5",  # R-hat and effective sample size to compare ours with.
        "hypothesis>=6.98",
        "mcap-ros2-support>=0.5",  # A second decoder, to check the bags that we write.
        "pytest>=7.4",
        "pytest-timeout>=2.2",
        "pytest-xdist>=3.5",  # Half of the time is waiting, between processes: two at once.
        "selenium>=4.15",  # Shows report.html to a browser, where there is one.
        "setuptools",  # Python 3.12 has none of its own, and a test reads setup.py.
        # A newer one finds more to say, and this tree must pass tomorrow as it does today.
        "mypy==2.4.*",
        "ruff==0.17.*",
        "types-PyYAML",
    ],
}


def shared_files() -> list[tuple[str, list[str]]]:
    """The files that go under share/: what ament asks for, and every file of SHARED_FOLDERS."""
    share = Path("share", NAME)
    by_folder = {
        Path("share/ament_index/resource_index/packages"): [f"resource/{NAME}"],
        share: ["package.xml"],
    }
    for path in sorted(path for name in SHARED_FOLDERS for path in Path(name).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            by_folder.setdefault(share / path.parent, []).append(str(path))
    return [(str(folder), files) for folder, files in by_folder.items()]


setup(
    name=NAME,
    version="0.1.0",
    description="Bayesian nonparametric inverse reinforcement learning for ROS 2",
    long_description=README.read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="bnirl_ros maintainers",
    maintainer="bnirl_ros maintainers",
    maintainer_email="bnirl-ros@example.com",
    license="Apache-2.0",
    keywords=["ROS", "inverse reinforcement learning", "learning from demonstration"],
    classifiers=[
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Topic :: Scientific/Engineering",
    ],
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={f"{NAME}.views": ["*.css", "*.html", "*.js"]},
    data_files=shared_files(),
    install_requires=REQUIREMENTS,
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "bnirl = bnirl_ros.cli:main",
            "discretiser_node = bnirl_ros.nodes.start:discretiser_node",
            "record_node = bnirl_ros.nodes.start:record_node",
            "replay_node = bnirl_ros.nodes.start:replay_node",
            "subgoal_node = bnirl_ros.nodes.start:subgoal_node",
        ],
    },
)
