import re
from glob import glob
from pathlib import Path

from setuptools import Extension, find_packages, setup

PACKAGE = "calib_ros"
# The core, and the packages beside it, which import the core and join it by entry points.
PACKAGES = [
    PACKAGE,
    *(f"{PACKAGE}_{name}" for name in ("thesis", "semantics", "check", "view", "synthetic", "evaluation")),
]

HERE = Path(__file__).resolve().parent
VERSION = re.search(r'^__version__ = "(.+?)"', (HERE / PACKAGE / "version.py").read_text(encoding="utf-8"), re.MULTILINE)[1]

EXTRAS = {
    # PCD, PLY and LAS files of plain folders as sources; clouds of bags that Draco compressed.
    "clouds": ["DracoPy", "laspy", "lazrs", "pypcd4", "trimesh"],
    # Video topics of bags.
    "video": ["av"],
    # Classes of pixels and points, which help the search (the built-in network, classes by shape), and Segment Anything.
    "semantics": ["onnxruntime"],
    # The vehicle's motion from consecutive scans, where no odometry gives it; LiDARs of a rig to each other.
    "motion": ["small_gicp"],
    # Pages of `calib-ros check`, of one recording or a fleet; fleet.parquet; several processes, or those of a cluster.
    "fleet": ["Jinja2", "distributed", "pyarrow"],
    # `calib-ros view`: the page in the browser; and --gif of `calib-ros replay` and `demo`.
    "view": ["nicegui", "pillow"],
    # `calib-ros evaluate` and `calib-ros steps`: reports, tables, pages and plots.
    "evaluation": ["Jinja2", "distributed", "matplotlib", "pandas"],
}
EXTRAS["all"] = sorted({library for libraries in EXTRAS.values() for library in libraries})
EXTRAS |= {
    # Where there is no ROS install, which it would shadow: ROS 2 Kilted from wheels. Pins of requirements.txt, since versions of
    # two distributions install together, then crash.
    "ros": [
        "ros-rclpy[fastrtps]==9.1.2",
        "ros-rmw-fastrtps-cpp==9.3.3",
        "ros-diagnostic-msgs==5.5.1",
        "ros-geometry-msgs==5.5.1",
        "ros-sensor-msgs==5.5.1",
        "ros-std-msgs==5.5.1",
        "ros-std-srvs==5.5.1",
        f"{PACKAGE}_msgs=={VERSION}",
    ],
    # colcon test picks pytest because it is named here.
    "test": ["pytest", "pytest-timeout", "pytest-xdist", "onnx", "selenium"],
}

setup(
    name=PACKAGE,
    version=VERSION,
    description="Online, targetless recalibration of the camera-LiDAR extrinsic, as a ROS 2 node and a Python library",
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="calib_ros developers",
    author_email="maintainers@calib-ros.dev",
    license="Apache-2.0",
    license_files=["LICENSE", f"{PACKAGE}_semantics/models/weights/LICENSE"],
    keywords=["calibration", "extrinsic", "camera", "lidar", "point cloud", "sensor fusion", "ros2", "kitti"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.10",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Programming Language :: Python :: 3.14",
        "Topic :: Scientific/Engineering :: Image Processing",
        "Topic :: Scientific/Engineering :: Image Recognition",
        "Typing :: Typed",
    ],
    # The inner loops of the scores, called through ctypes, so that one build fits every Python: its wheel says so (abi3).
    ext_modules=[
        Extension(
            f"{module.replace('/', '.')}.kernel",
            [f"{module}/kernel.c"],
            py_limited_api=True,
            # No fused operations: the same bits on processors with and without them. The last two let more loops become vector
            # instructions, and change no result.
            extra_compile_args=["-std=gnu99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"],
        )
        for module in (f"{PACKAGE}/registration/score", f"{PACKAGE}_thesis")
    ],
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
    packages=find_packages(include=[pattern for name in PACKAGES for pattern in (name, f"{name}.*")]),
    package_data={name: ["py.typed"] for name in PACKAGES}
    | {
        f"{PACKAGE}_semantics": ["py.typed", "models/weights/*.onnx", "models/weights/LICENSE"],
        f"{PACKAGE}_thesis": ["py.typed", "presets/*.yaml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*")),
        (f"share/{PACKAGE}/config/presets", glob(f"{PACKAGE}_thesis/presets/*.yaml")),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
    ],
    python_requires=">=3.10",
    # What `import calib_ros`, a calibration and bags need. Only pip reads this list: `colcon build` takes the
    # libraries of the ROS install that package.xml names, among them the cv2 that cv_bridge needs, and the console scripts start
    # without checking the list. rclpy and the messages come from ROS, or by the extra `ros`.
    install_requires=["numpy", "scipy", "PyYAML", "tqdm", "opencv-python-headless", "rosbags"],
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "calib-ros = calib_ros.cli.main:main",
            "calib_node = calib_ros.ros.process:calib_node",
            "calib_lifecycle_node = calib_ros.ros.process:calib_lifecycle_node",
        ],
        # What the packages beside the core bring, see calib_ros/extensions.py.
        "calib_ros.objectives": [
            "thesis = calib_ros_thesis.objective:ThesisObjective",
        ],
        "calib_ros.classes": [
            "semantics = calib_ros_semantics.joining:MODELS",
        ],
        "calib_ros.stages": [
            "thesis = calib_ros_thesis.config:ThesisConfig",
        ],
        "calib_ros.presets": [
            "thesis = calib_ros_thesis.presets:THESIS",
            "thesis-literal = calib_ros_thesis.presets:LITERAL",
        ],
        "calib_ros.sources": [
            "synthetic = calib_ros_synthetic.rig:open_drive",
        ],
        "calib_ros.rigs": [
            "synthetic = calib_ros_synthetic.rig:open_rig",
        ],
        "calib_ros.commands": [
            "check = calib_ros_check.commands:CHECK",
            "certify = calib_ros_check.commands:CERTIFY",
            "demo = calib_ros_synthetic.commands:DEMO",
            "models = calib_ros_semantics.commands:MODEL_COMMAND",
            "view = calib_ros_view.commands:VIEW",
            "evaluate = calib_ros_evaluation.cli:EVALUATE",
            "steps = calib_ros_evaluation.cli:STEPS",
        ],
        "calib_ros.pages": [
            "rig = calib_ros_check.report:rig_page",
            "gif = calib_ros_view.session.film:film",
        ],
        "calib_ros.node_services": [
            "check = calib_ros_check.node.server:CheckServer",
            "keyframes = calib_ros_view.node.keyframes:KeyframeServer",
        ],
    },
)
