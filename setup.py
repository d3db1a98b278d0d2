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
    version='0.2.0',
    description='Online localisation and shape estimation of continuum robots',
    license='Apache-2.0',
    packages=find_packages(include=['continuum_loc*', 'msg_tools*']),
    package_data={
        'continuum_loc': ['**/*.yaml', '**/*.html', '**/*.js', '**/*.j2'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml', 'requirements-jazzy.txt']),
        (f'share/{NAME}/launch', _files('launch', '*.launch.py')),
        (f'share/{NAME}/config', _files('config', '*.yaml')),
        (f'share/{NAME}/rviz', _files('rviz', '*.rviz')),
        (f'share/{NAME}/foxglove', _files('foxglove', '*.json')),
        # `ros2 run` looks in lib/<package>. Modern pip ignores the redirect of setup.cfg and puts
        # the commands on PATH alone, so small wrappers go there; under colcon its own scripts of
        # the same name win.
        (f'lib/{NAME}', _files('resource/executables', '*')),
    ],
    python_requires='>=3.11',
    # What the nodes, `replay` and `shape` need; for everything else there are extras, and
    # `continuum_loc.extras` says what to type where something is missing. The versions are the
    # oldest that were tried: `make test-noble`.
    install_requires=[
        'numpy>=1.26.4',
        'scipy>=1.11.4',
        'numba>=0.58.1',
        'llvmlite',  # which numba brings; its version is part of what a kernel was made of
        'threadpoolctl>=3.1.0',
        'pydantic>=2.4.2',
        'pyyaml>=6.0.1',
        'rosbags>=0.11.7',
        'lz4',  # which rosbags brings, as the next; bags that were cut off are read without it
        "backports.zstd; python_version < '3.14'",
        'typer>=0.12.5',
        'rich>=13.7.1',
    ],
    extras_require={
        # To simulate, and to draw scenes.
        'simulate': [
            'mujoco>=3.17',
            'manifold3d>=3.5',
            'coacd>=1.0.14',
            'open3d>=0.20',
            'trimesh>=5.2',
        ],
        # To write reports and tables.
        'report': ['plotly>=7.1', 'jinja2>=3.1.2', 'pandas>=2.1.4', 'pillow>=10.2'],
        # All that a user of the command line may ask for.
        'all': ['continuum_loc[simulate,report]'],
        # To run the studies of a checkout.
        'studies': ['continuum_loc[all]', 'matplotlib>=3.8', 'psutil>=5.9.8'],
        # To run the tests of a checkout.
        'test': [
            'continuum_loc[studies]',
            'pytest',
            'pytest-timeout',
            'hypothesis',
            'evo',
            'ruff',
            'import-linter',
        ],
        # To run the benchmarks of a checkout: what they compare with.
        'bench': [
            'continuum_loc[studies]',
            'gtsam',
            'mcap-ros2-support',
            'small_gicp',
        ],
        # To spread studies over a cluster.
        'cluster': ['dask', 'distributed'],
        # Where there is no ROS 2 installation, the same Jazzy packages as wheels.
        'ros': ['ros-jazzy-rclpy[fastrtps]==7.1.6', 'ros-common-interfaces==5.3.6'],
    },
    zip_safe=False,
    maintainer='continuum_loc maintainers',
    maintainer_email='continuum-loc@users.noreply.github.com',
    entry_points={
        'console_scripts': [f'{node} = {NAME}.start:{node}' for node in NODES]
        + [f'continuum-loc = {NAME}.start:command_line'],
    },
)
