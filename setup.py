from glob import glob

from setuptools import find_packages, setup

PACKAGE = "calib_ros"
EVALUATION = "calib_ros_evaluation"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Online targetless recalibration of the camera-LiDAR extrinsic",
    author="calib_ros developers",
    author_email="maintainers@calib-ros.dev",
    license="Apache-2.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*", EVALUATION, f"{EVALUATION}.*"]),
    package_data={PACKAGE: ["semantics/weights/*.onnx"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*")),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
    ],
    python_requires=">=3.10",
    # Only what apt's packages of a ROS install declare to pip too. OpenCV's does not: a pip OpenCV named here
    # would make a plain `pip install` put a second cv2, and a newer numpy, over those that cv_bridge needs.
    # rclpy and the messages come from ROS. Console scripts start without checking this list.
    install_requires=["numpy", "scipy", "PyYAML", "tqdm"],
    extras_require={
        "pip": ["opencv-python-headless", "onnxruntime", "rosbags"],
        # The vehicle's motion from consecutive scans, where no odometry tells it.
        "motion": ["small_gicp"],
        # The thesis's objective, and the pages and plots of `calib-ros steps`.
        "thesis": ["Jinja2", "matplotlib", "scikit-learn"],
        # `calib-ros evaluate --scheduler`, trials on a Dask cluster.
        "cluster": ["distributed"],
        # To train the network of training/; nothing of it is needed at run time.
        "training": ["onnx", "onnxscript", "torch"],
        # colcon test picks pytest because it is named here.
        "test": ["pytest"],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "calib-ros = calib_ros.cli.main:main",
            "calib_node = calib_ros.ros.node:main",
        ],
        # Commands that join `calib-ros`, see calib_ros.cli.arguments.Extension.
        "calib_ros.commands": [
            "evaluate = calib_ros_evaluation.cli:EVALUATE",
            "steps = calib_ros_evaluation.cli:STEPS",
        ],
    },
)
