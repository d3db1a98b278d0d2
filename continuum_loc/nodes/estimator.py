"""Node `estimator`: sensors in, the whole body's pose out (see docs and config/estimator.yaml)."""

from __future__ import annotations

from functools import partial
from pathlib import Path
import sys
from typing import Any

from continuum_loc.errors import FrameError, MessageError, SettingsError
from continuum_loc.estimate import Estimate
from continuum_loc.estimator import EstimatorSettings, settings_of, SlidingWindowFilter
from continuum_loc.estimator.settings import PRESETS_FOLDER
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    Measurement,
    nanoseconds,
    TofFrame,
)
from continuum_loc.nodes.support import parameters
from continuum_loc.nodes.support.body import body_message, ring_records, ring_topics
from continuum_loc.nodes.support.frames import FrameTree
from continuum_loc.nodes.support.memory import RecentPoses, SeenScene
from continuum_loc.nodes.support.placing import is_planar, placed_base, raised, with_base
from continuum_loc.nodes.support.progress import compiling
from continuum_loc.nodes.support.runtime import run
from continuum_loc.nodes.support.settings import EstimatorNodeSettings
from continuum_loc.nodes.support.transforms import (
    available,
    Broadcaster,
    Frames,
    listen_to_frames,
)
from continuum_loc.nodes.support.warm_up import warm_up
from continuum_loc.nodes.support.worker import ERROR, OK, WARN, WorkerNode
from continuum_loc.robot import RobotDescription
from geometry_msgs.msg import PoseWithCovarianceStamped
from msg_tools.factory import ros_messages
from msg_tools.geometry import MAP
from msg_tools.records import CloudRecord, PosesRecord
from msg_tools.results import columns_message, map_record, tip_message
from msg_tools.topics import INPUTS, tip_of, TRACKER
import numpy as np
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

FILTER = 'filter.'
POORLY_KNOWN = 0.05  # [m] a ring farther from known in some direction is told


class EstimatorNode(WorkerNode):
    """The sliding-window filter on a graph."""

    inputs = (*INPUTS, TRACKER)

    def __init__(self, **options: Any) -> None:
        super().__init__('estimator', EstimatorNodeSettings(), **options)
        self.filter_settings = parameters.declare(self, self._preset(), FILTER, live=True)
        self.check_parameters()
        self.prior_map: PriorMap | None = None
        self.filter: SlidingWindowFilter | None = None
        self.estimate: Estimate | None = None
        self.recent = RecentPoses(self.settings.trajectory_seconds)
        self.scene: SeenScene | None = None
        self.frames = Frames.of(self.robot, self.settings)
        self.tree = FrameTree()
        self.tf: Broadcaster | None = None
        self.body: Any = None
        self._insertion = 0.0
        self._scene_published = 0
        self._told_base = 0  # stamp of the newest pose of the base that was taken from /tf
        self._hypotheses: Any = None

    # ------------------------------------------------ life

    def prepare(self) -> None:
        """Load the map, compile the filter, offer services and outputs."""
        self.prior_map = self._load_map(self.settings.map)
        self.scene = SeenScene(self.robot, self.prior_map, self.settings.reconstruction_seconds)
        self.filter = self._new_filter(self.robot)
        self.estimate = None
        self._warm_up()
        self._offer_services()
        if available():
            self.tf = Broadcaster(self, self.frames, self.tree)
        elif self.frames.tf != 'none':
            self.get_logger().warning(
                'no TF: tf2_msgs is not installed (apt install ros-jazzy-tf2-msgs)'
            )
        topics = ('poses', 'backbone', 'tip', 'reconstruction', *ring_topics(self.robot))
        base = self.robot.base
        if base.mode == 'measured':
            topics += ('base/frame', *(['base/pose'] if self.settings.base_tf else []))
        if base.mode == 'free' and base.region[0] > 0.0:
            topics += ('base/hypotheses',)
        if self.robot.actuation is not None:
            topics += ('load',)
        for topic in topics:
            self.publisher(topic)
        markers = ros_messages().resolve('visualization_msgs/msg/MarkerArray')
        self.body = self.managed_publisher(markers, 'body', QoSProfile(depth=5))

    def activate(self) -> None:
        """Show the map and the fixed frames, and hear the sensors."""
        self._publish_map()
        if self.tf is not None:
            self.tf.send_fixed()
            listen_to_frames(self, self.tree)
        super().activate()
        if self.settings.base_tf:
            self.every(1.0 / self.robot.base.measurement.rate, self._tell_base)

    # ------------------------------------------------ the filter (worker thread)

    def consume(self, measurement: Measurement) -> int | None:
        """One measurement through the filter; publish the estimate when a step fell due."""
        if isinstance(measurement, TofFrame):
            self.scene.see(measurement)
        if isinstance(measurement, EncoderSample) and 'insertion' in measurement.names:
            self._insertion = float(measurement.position[measurement.names.index('insertion')])
        estimate = self.filter.process(measurement)
        self._publish_hypotheses(measurement.stamp)
        if estimate is None:
            return None
        self._publish(estimate)
        return estimate.stamp

    def _tell_base(self) -> None:
        """Put what /tf newly says of the base onto `base/pose`, where it is heard and recorded."""
        frame, carrier = self.robot.base.measurement.frame, self.settings.base_tf
        stamp = self.tree.latest(frame, carrier)
        if stamp is None or stamp <= self._told_base:
            return
        try:
            T_frame_base = self.tree.transform(frame, carrier, stamp)
        except FrameError as error:
            self.get_logger().warning(f'base_tf: {error}', throttle_duration_sec=10.0)
            return
        self._told_base = stamp
        self.publish('base/pose', BaseSample(stamp, frame, T_frame_base))

    def _publish_hypotheses(self, stamp: int) -> None:
        """Publish where the base may be, whenever a search has found other places."""
        found = self.filter.start.hypotheses
        if found is not self._hypotheses and len(found):
            self.publish('base/hypotheses', PosesRecord(stamp, found))
        self._hypotheses = found

    def idle(self) -> bool:
        """Place what the ToF sensors saw an instant ago, and publish it when it is due."""
        if not self.scene.work():
            return False
        since = self.scene.stamp - self._scene_published
        if not 0 <= since < nanoseconds(1.0 / self.settings.reconstruction_rate):
            self._scene_published = self.scene.stamp
            self.publish('reconstruction', self.scene.record())
        return True

    def restart(self) -> None:
        """Start anew from the base, as after ~/reset."""
        self.filter.reset()
        self.scene.clear()
        self.estimate = None

    def describe(self) -> tuple[int, str, dict[str, Any]]:
        """Lost and doubtful are errors; starting, suspects, what nothing observes are warnings."""
        estimate = self.estimate
        if estimate is None:
            places = len(self.filter.start.hypotheses) if self.filter is not None else 0
            looked = f': {places} places fit, move on' if places > 1 else ''
            return WARN, f'no estimate yet{looked}', {}
        inliers = (
            float(np.mean(list(estimate.inliers.values()))) if estimate.inliers else float('nan')
        )
        suspects = ', '.join(f'{name} ({why})' for name, why in estimate.suspects.items())
        number, sigma, axis = estimate.least_known
        ring = ('base', *self.robot.ring_names)[number]
        recent = self.step.recent(30)
        values = {
            'status': estimate.status,
            'consistency': estimate.consistency,
            'inliers': inliers,
            'suspects': suspects or 'none',
            'least known': f'{ring} to {1e3 * sigma:.1f} mm along {np.round(axis, 2).tolist()}',
            'iterations': estimate.iterations,
            'step mean [ms]': float(1e3 * recent.mean()) if len(recent) else float('nan'),
            'latency [ms]': float(1e3 * np.median(self.latency.recent(30)))
            if self.latency.values
            else 'unknown',
            'rate [Hz]': _rate(self.recent),
        }
        return *_verdict(estimate, suspects, values['least known']), values

    def summary(self) -> dict[str, Any]:
        """Add the filter's own counts."""
        return super().summary() | {'filter': self.filter.counts if self.filter else {}}

    # ------------------------------------------------ outputs

    def publish_message(self, topic: str, message: Any) -> None:
        """Publish a message, its frame named as the user has it."""
        if message.header.frame_id == MAP:
            message.header.frame_id = self.frames.map
        super().publish_message(topic, message)

    def deserialized(self, data: bytes, type_name: str) -> Any:
        """Return the message, the map's frame in it named as everywhere in here."""
        message = super().deserialized(data, type_name)
        header = getattr(message, 'header', None)
        if header is not None and header.frame_id.lstrip('/') == self.frames.map:
            header.frame_id = MAP
        return message

    def _publish(self, estimate: Estimate) -> None:
        before, self.estimate = self.estimate, estimate
        if estimate.doubts and (before is None or not before.doubts):
            self.get_logger().warning(f'doubtful: {"; ".join(estimate.doubts)}')
        self.publish('poses', estimate)
        self._publish_for_those_who_listen(estimate)
        tip = tip_message(ros_messages(), tip_of(estimate), self.frames.rings[-1])
        self.publish_message('tip', tip)
        self.publish('backbone', estimate)
        if estimate.T_map_frame is not None:
            self.publish('base/frame', estimate)
        if self.robot.actuation is not None:
            self.publish('load', estimate)
        if self.tf is not None:
            self.tf.send(estimate.stamp, estimate.T_map_ring, estimate.T_map_frame)
        self.recent.add(estimate)
        smoothed = estimate.lagged if self.filter_settings.lag > 0.0 else estimate
        if smoothed is not None:
            self.scene.follow(smoothed)

    def _publish_for_those_who_listen(self, estimate: Estimate) -> None:
        """Publish what costs something to write: each ring by itself, and the body to look at."""
        for topic, item in ring_records(self.frames, estimate):
            if self.publisher(topic).get_subscription_count():
                self.publish(topic, item)
        if self.body is not None and self.body.get_subscription_count():
            self.body.publish(body_message(ros_messages(), self.frames, estimate))

    def _publish_map(self) -> None:
        if self.prior_map is None:
            return
        record = map_record(self.now(), self.prior_map)
        most = self.settings.map_points or len(record.fields['x'])
        keep = np.linspace(
            0, len(record.fields['x']) - 1, min(most, len(record.fields['x']))
        ).astype(int)
        thin = CloudRecord(
            record.stamp, {name: values[keep] for name, values in record.fields.items()}
        )
        self.publish_message('prior_map', columns_message(ros_messages(), thin))

    # ------------------------------------------------ services, initialpose, parameters

    def _offer_services(self) -> None:
        for name, action in (
            ('reset', self._reset),
            ('clear_faults', self._clear_faults),
            ('save_map', self._save_map),
            ('save_trajectory', self._save_trajectory),
        ):
            self.serve(Trigger, f'~/{name}', partial(_answer, action))
        for topic in ('initialpose', 'set_pose'):
            self.listen(
                'geometry_msgs/msg/PoseWithCovarianceStamped',
                topic,
                partial(self._place, topic),
                QoSProfile(depth=10),
            )

    def _reset(self) -> str:
        self.in_worker(lambda: self._rebuild(self.robot))
        return 'the estimate starts anew with the next sample'

    def _clear_faults(self) -> str:
        self.in_worker(lambda: self.filter.forget_faults())
        return 'every sensor is believed again, until it is found out anew'

    def _save_map(self) -> str:
        path = self._output('reconstruction.ply')
        self.scene.save(path)
        return str(path)

    def _save_trajectory(self) -> str:
        from continuum_loc.trajectory import save_tum

        track = self.recent.trajectory(self.robot)
        if not len(track):
            raise ValueError('there is no estimate yet')
        save_tum(track, self._output(''), 'estimate')
        return str(self._output(''))

    def _output(self, name: str) -> Path:
        folder = Path(self.settings.output_folder).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        return folder / name

    def _place(self, topic: str, message: PoseWithCovarianceStamped) -> None:
        """
        Take the base's present pose, in any frame, and start the estimate anew.

        On `initialpose` a planar one, as RViz's tool gives it, has no height.
        """
        planar = topic == 'initialpose' and is_planar(message)
        try:
            pose = placed_base(message, self.frames.map, self.tree)
        except (MessageError, FrameError) as error:
            self.intake.refuse(getattr(error, 'kind', 'frame'), f'{topic}: {error}')
            return
        T_map_base = raised(self.robot, pose.T_map_sensor) if planar else pose.T_map_sensor
        robot = with_base(self.robot, T_map_base, pose.covariance, self._insertion)
        self.in_worker(partial(self._rebuild, robot))
        kept = ', at the height, roll and pitch of the robot description' if planar else ''
        self.get_logger().info(f'{topic}: the estimate starts anew from this base{kept}')

    def _change(self, values: dict[str, Any]) -> str | None:
        """Filter settings take effect at once, by a new start; the rest is as for every node."""
        mine = {name: value for name, value in values.items() if name.startswith(FILTER)}
        if mine:
            self.filter_settings = parameters.read(
                self, type(self.filter_settings), FILTER, changed=mine
            )
            if self.filter is not None:
                self.in_worker(lambda: self._rebuild(self.robot))
        if 'map' in values:
            self._change_map(values['map'])
        rest = {name: value for name, value in values.items() if name not in mine}
        reason = super()._change(rest) if rest else None
        if self.scene is not None:
            self.scene.duration = self.settings.reconstruction_seconds
        return reason

    def _change_map(self, path: str) -> None:
        """Match to another map from now on; raises MapError or SettingsError where it cannot."""
        if not path:
            raise SettingsError("parameter 'map': it can be changed while running, not taken away")
        if self.filter is None:
            return  # it is loaded when the node is configured
        prior = self._load_map(path)
        prior.index  # noqa: B018  (made here, so that the worker need not)
        self.in_worker(partial(self._use_map, prior))

    def _use_map(self, prior: PriorMap) -> None:
        self.prior_map = prior
        self.filter.use_map(prior)
        self.scene = SeenScene(self.robot, prior, self.settings.reconstruction_seconds)
        self._publish_map()
        self.get_logger().info(f'another map: {len(prior)} points; shape and biases stay')

    def _rebuild(self, robot: RobotDescription) -> None:
        self.robot = robot
        self.filter = self._new_filter(robot)
        self.intake.gate.reset()
        self.scene.clear()
        self.estimate = None

    def _new_filter(self, robot: RobotDescription) -> SlidingWindowFilter:
        """Make a filter without a past, which no graph asks for."""
        settings = self.filter_settings.model_copy(update={'history': 0.0})
        return SlidingWindowFilter(robot, self.prior_map, settings)

    def _preset(self) -> EstimatorSettings:
        """Use the settings asked for, else those bundled for this robot, else the library's."""
        bundled = (PRESETS_FOLDER / f'{self.robot.name}.yaml').is_file()
        if not self.settings.settings and not bundled:
            self.get_logger().warning(
                f"no settings are tuned for robot '{self.robot.name}': using the defaults "
                '(parameter `settings`; `continuum-loc tune` finds better ones)'
            )
        return settings_of(self.robot.name, self.settings.settings)

    def _load_map(self, path: str) -> PriorMap | None:
        if not path:
            self.get_logger().warning('no prior map: ToF sensors cannot be used (parameter `map`)')
            return None
        from continuum_loc.mapping.scale import map_for

        prior = map_for(self.robot, path)
        for note in prior.notes:
            self.get_logger().warning(f'{path}: {note}')
        return prior

    def _warm_up(self) -> None:
        if self.settings.warm_up:
            with compiling(self.get_logger().info):
                warm_up(self.robot, self.prior_map, self.filter_settings, self.scene)


def _verdict(estimate: Estimate, suspects: str, least_known: str) -> tuple[int, str]:
    """Say in a line what is the matter, the gravest first."""
    if estimate.status == 'lost':
        return ERROR, 'lost'
    if estimate.status == 'initialising':
        return WARN, 'initialising'
    if estimate.status == 'doubtful':
        return ERROR, f'doubtful: {"; ".join(estimate.doubts)}'
    if estimate.suspects:
        return WARN, f'suspect: {suspects}'
    if estimate.least_known[1] > POORLY_KNOWN:
        return WARN, f'nothing observes {least_known}'
    if not estimate.converged:
        return WARN, 'the last step did not converge'
    return OK, 'tracking'


def _answer(action: Any, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    try:
        response.message, response.success = action(), True
    except (ValueError, OSError) as error:
        response.message, response.success = str(error), False
    return response


def _rate(poses: RecentPoses) -> float:
    stamps = poses.recent(16)
    return 1e9 * (len(stamps) - 1) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else 0.0


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(EstimatorNode, args))


if __name__ == '__main__':
    main()
