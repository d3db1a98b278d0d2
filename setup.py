"""Packaging that serves a colcon workspace (ament_python) and plain pip alike."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = 'continuum_loc'
NODES = ('simulator', 'estimator', 'shape', 'recorder', 'replayer', 'driver', 'viewer')
HERE = Path(__file__).parent


def _files(folder: str, *patterns: str) -> list[str]:
    return sorted(
        str(path.relative_to(HERE))
        for pattern in patterns
        for path in (HERE / folder).glob(pattern)
    )


setup(
    name=NAME,
    version='0.1.0',
    description='Online localisation and shape estimation of continuum robots',
    license='Apache-2.0',
    packages=find_packages(include=['continuum_loc*', 'msg_tools*']),
    package_data={
        'continuum_loc': ['robots/*.yaml', '**/*.yaml', '**/*.html', '**/*.j2', '**/*.rviz']
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', _files('launch', '*.launch.py')),
        (f'share/{NAME}/config', _files('config', '*.yaml')),
        (f'share/{NAME}/rviz', _files('rviz', '*.rviz')),
        # `ros2 run` looks in lib/<package>. Modern pip ignores the redirect of setup.cfg and puts
        # the commands on PATH alone, so small wrappers go there; under colcon its own scripts of
        # the same name win.
        (f'lib/{NAME}', _files('resource/executables', '*')),
    ],
    python_requires='>=3.11',
    install_requires=[
        'setuptools',
        'numpy',
        'scipy',
        'numba',
        'threadpoolctl',
        'pydantic>=2',
        'pyyaml',
        'rosbags>=0.11',
        'typer',
        'rich',
        'mujoco>=3.3',
        'open3d',
        'trimesh',
        'manifold3d',
        'coacd',
        'pandas',
        'jinja2',
        'plotly',
        'matplotlib',
        'psutil',
        'pillow',
    ],
    extras_require={
        # Where there is no ROS 2 installation, the same Jazzy packages as wheels.
        'ros': ['ros-jazzy-rclpy[fastrtps]==7.1.6', 'ros-common-interfaces==5.3.6'],
        'test': ['pytest', 'pytest-timeout', 'hypothesis', 'evo', 'ruff'],
        'bench': ['gtsam', 'mcap-ros2-support', 'small_gicp'],
        'cluster': ['dask', 'distributed'],
    },
    zip_safe=False,
    maintainer='continuum_loc maintainers',
    maintainer_email='continuum-loc@users.noreply.github.com',
    entry_points={
        'console_scripts': [f'{node} = {NAME}.nodes.{node}:main' for node in NODES]
        + ['continuum-loc = continuum_loc.cli:main'],
    },
)
