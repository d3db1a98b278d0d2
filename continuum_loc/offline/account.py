"""
The plain account at the end of a run: what came, what was used of it, what not, and why.

Also which sensors were suspects and for how long, and how honest the covariance was. The same goes
into `summary.json` and onto the terminal.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
import math
import re
from typing import Any

from continuum_loc.estimate import Estimate
from continuum_loc.measurements import NANOSECONDS, TOF_HALF_CONFIDENT, TOF_NO_TARGET, TOF_VALID
from continuum_loc.robot import RobotDescription

KINDS = {  # topic -> what a filter counts it as
    'tof/points': 'TofFrame',
    'imu/data_raw': 'ImuSample',
    'imu/mag': 'FieldSample',
    'strain': 'StrainSample',
    'tracker/': 'TrackedPose',
    'joint_states': 'EncoderSample',
    'base/': 'BaseSample',
}
TRUTH = 'ground_truth/poses'
BAG = 'bag'  # for what is wrong with all of it
LONGEST_STEP = NANOSECONDS  # between two estimates over which a suspect is one
HONEST, SURE = (0.5, 1.5), 3.0  # of a figure that is 1 where the covariance is honest
SHOWN = 5  # reasons or suspects on the terminal; all are in the summary
WIDTH = 160  # characters of a reason


class Suspicion:
    """For how long each sensor was a suspect, and why."""

    def __init__(self) -> None:
        self._last = 0
        self._seconds: dict[str, Counter[str]] = defaultdict(Counter)

    def note(self, estimate: Estimate) -> None:
        """Take the next estimate: its suspects have been that since the one before."""
        step, self._last = estimate.stamp - self._last, estimate.stamp
        for name, reason in estimate.suspects.items():
            # How late or how far off it is changes from step to step.
            kind = re.sub(r'\d+ ms | \(.*\)', '', reason)
            self._seconds[name][kind] += step / NANOSECONDS if 0 < step <= LONGEST_STEP else 0.0

    def table(self) -> dict[str, dict[str, float]]:
        """Seconds by sensor and reason, those of the longest first."""
        order = sorted(self._seconds, key=lambda name: -self._seconds[name].total())
        return {name: dict(self._seconds[name].most_common()) for name in order}


def account_of(
    robot: RobotDescription, settings: Any, counts: Mapping[str, Any], summary: Mapping[str, Any]
) -> dict[str, Any]:
    """
    Give the account of a run from its counts and summary.

    counts: of the filter, of the gate under `intake`, and of the suspects, as a replay's.
    `problems` are the reasons for which the run came to nothing, or a whole kind of sensor did.
    """
    intake, wanted = counts['intake'], wanted_topics(robot, settings)
    rows = {topic: _row(topic, counts) for topic in KINDS if _sum(intake['received'], topic)}
    truth = _row(TRUTH, counts)
    unused = [name for name in wanted if name in rows and not rows[name]['used']]
    problems = [_unused(name, rows[name], counts) for name in unused]
    if truth['received'] and not truth['used']:
        problems.append(f'no truth could be used: {truth["first"]}')
    problems += [one['first'] for one in intake['refusals'].get(BAG, {}).values()]
    if not summary['estimates']['all']:
        came = ', '.join(f'{row["received"]} {name}' for name, row in rows.items())
        problems.insert(0, f'no estimate: {came or "no measurement in it"}')
    return {
        'problems': problems,
        'topics': rows | ({TRUTH: truth} if truth['received'] else {}),
        'absent': [name for name in wanted if name not in rows],
        'dropped_by_queue': dict(intake.get('dropped', {})),
        'dropped_by_filter': dict(counts.get('dropped', {})),
        'restarts': _total(intake['restarts']) + _total(counts.get('restarts', 0)),
        'failures': intake['failures'],
        'tof_status': _shares(intake['tof_status']),
        'suspects': counts.get('suspects', {}),
        'covariance': _covariance(summary),
    }


def wanted_topics(robot: RobotDescription, settings: Any) -> list[str]:
    """Topics of which something should be used: the robot has them, the settings want them."""

    def on(*names: str) -> bool:
        groups = [getattr(settings, name) for name in names if hasattr(settings, name)]
        return not groups or any(getattr(group, 'enabled', True) for group in groups)

    has = {
        'tof/points': robot.tof and on('tof'),
        'imu/data_raw': robot.imu and on('gyro', 'gravity'),
        'imu/mag': robot.hall and robot.magnet is not None and on('field'),
        'strain': robot.strain is not None and on('strain'),
        'tracker/': robot.trackers and on('tracker'),
        'joint_states': robot.base.insertion.mode == 'measured' and hasattr(settings, 'tof'),
        'base/': robot.base.mode == 'measured' and on('base'),
    }
    return [name for name, wanted in has.items() if wanted]


def account_lines(account: Mapping[str, Any]) -> Iterator[str]:
    """Yield the account in plain words, a line each; the terminal shows it under the table."""
    yield 'used of received: ' + ', '.join(
        f'{name.rstrip("/")} {row["used"]:,} of {row["received"]:,}'
        for name, row in account['topics'].items()
    )
    yield from _refusals(account)
    if account['absent']:
        yield f'not in the bag, though the robot has it: {", ".join(account["absent"])}'
    if account['tof_status']:
        said = (f'{name} {100 * share:.1f} %' for name, share in account['tof_status'].items())
        yield f'ToF zones: {", ".join(said)}'
    yield f'suspects: {_suspects(account["suspects"])}'
    yield f'covariance: {account["covariance"]["said"]}'
    yield from (f'PROBLEM: {problem}' for problem in account['problems'])


def _refusals(account: Mapping[str, Any]) -> Iterator[str]:
    refused = [
        (count, f'{kind}: {first}')
        for row in account['topics'].values()
        for kind, (count, first) in row['refused'].items()
    ]
    refused.sort(key=lambda one: -one[0])
    for count, text in refused[:SHOWN]:
        yield f'refused {count:,} as {text[:WIDTH]}'
    if len(refused) > SHOWN:
        rest = sum(count for count, _ in refused[SHOWN:])
        yield f'refused {rest:,} for {len(refused) - SHOWN} more reasons (see summary.json)'
    for what in ('queue', 'filter'):
        dropped = Counter(account[f'dropped_by_{what}']).most_common(SHOWN)
        if dropped:
            said = ', '.join(f'{count:,} {reason}' for reason, count in dropped)
            yield f'dropped by the {what}: {said}'
    if account['restarts'] or account['failures']:
        yield f'started anew {account["restarts"]} times, failed {account["failures"]} times'


def _row(topic: str, counts: Mapping[str, Any]) -> dict[str, Any]:
    """Count what became of a topic (`tracker/`: of all trackers) on its way into the estimate."""
    intake = counts['intake']
    refused: dict[str, list] = {}
    for name, kinds in intake['refusals'].items():
        for kind, one in kinds.items() if _is(name, topic) else ():
            before, first = refused.get(kind, (0, one['first']))
            refused[kind] = [before + one['count'], first]
    passed = _sum(intake['used'], topic)
    by_kind = set(counts.get('received', {})) & set(KINDS.values())
    used = counts['used'].get(KINDS[topic], 0) if by_kind and topic in KINDS else passed
    first = next((first for _, first in refused.values()), '')
    return {
        'received': _sum(intake['received'], topic),
        'used': min(used, passed),
        'refused': refused,
        'first': first,
    }


def _unused(topic: str, row: Mapping[str, Any], counts: Mapping[str, Any]) -> str:
    why = row['first'] or ', '.join(
        f'{count} {reason}' for reason, count in counts.get('dropped', {}).items()
    )
    return f'none of {row["received"]} {topic.rstrip("/")} was used: {why or "see summary.json"}'


def _shares(status: Mapping[str, int]) -> dict[str, float]:
    """Shares of the zones by what their status says of them."""
    total, shares = sum(status.values()), Counter()
    names = {TOF_VALID: 'valid', TOF_NO_TARGET: 'no target'}
    names |= dict.fromkeys(TOF_HALF_CONFIDENT, 'half sure')
    for code, count in status.items():
        shares[names.get(int(code), f'status {code}')] += count / total
    return dict(shares.most_common())


def _suspects(suspects: Mapping[str, Mapping[str, float]]) -> str:
    said = [
        f'{name} {reason} for {seconds:.1f} s'
        for name, reasons in suspects.items()
        for reason, seconds in reasons.items()
    ]
    more = f', and {len(said) - SHOWN} more (see summary.json)' if len(said) > SHOWN else ''
    return ', '.join(said[:SHOWN]) + more or 'none'


def _covariance(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Say how honest the covariance was: by truth where there is any, else by the data itself."""
    nees, consistency = summary['nees_per_dof'], summary.get('consistency')
    if nees is not None and math.isfinite(nees):
        inside = 100 * summary['coverage_95']
        figures = f'NEES {nees:.2f} per degree of freedom, {inside:.0f} % inside the 95 % bound'
        return {'figure': nees, 'by': 'truth', 'said': f'{_honesty(nees)} ({figures})'}
    if consistency is None or not math.isfinite(consistency):
        return {'figure': None, 'by': 'nothing', 'said': 'cannot be judged'}
    figures = f'no truth; the data fit it with {consistency:.2f}, where 1 is honest'
    return {'figure': consistency, 'by': 'data', 'said': f'{_honesty(consistency)} ({figures})'}


def _honesty(figure: float) -> str:
    if figure < HONEST[0]:
        return 'more careful than it need be'
    if figure <= HONEST[1]:
        return 'honest'
    times = f'errors are {math.sqrt(figure):.1f} times what it says'
    return f'a little too sure, {times}' if figure <= SURE else f'NOT to be believed, {times}'


def _is(name: str, topic: str) -> bool:
    return name.startswith(topic) if topic.endswith('/') else name == topic


def _sum(counts: Mapping[str, int], topic: str) -> int:
    return sum(count for name, count in counts.items() if _is(name, topic))


def _total(counts: int | Mapping[str, int]) -> int:
    return counts if isinstance(counts, int) else sum(counts.values())
