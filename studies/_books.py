"""
The books: what is tuned on, what is reported, and every time that something was reported.

A study whose figures the documents quote may be run as often as one likes with the same numbers of
the filter. With others it would be tuning on what is reported, unless both results are told:
`docs/reported.md` gets a row for each, and without it the study refuses to run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from datetime import date
import hashlib
import json
from pathlib import Path

from continuum_loc.closure import said_by
from continuum_loc.errors import StudyError
from continuum_loc.estimator.settings import PRESETS_FOLDER
from continuum_loc.offline.claims import Claim
from continuum_loc.offline.trials import Trial
from studies.support.split import DETECTOR_HOLD_OUT, HOLD_OUT

ROOT = Path(__file__).parents[1]
LOG = ROOT / 'docs' / 'reported.md'
CHECKSUMS = Path(__file__).parent / 'support' / 'sets.sha256'
REPORTED = (
    'table2',
    'table3',
    'table4',
    'consistency',
    'faults',
    'implausible',
    'ablation',
    'anomalies',
    'world',
)
HEADING = """# What was reported, and when

Written by `continuum-loc evaluate` whenever a study runs in full whose figures the documents
quote: one row for each set of the filter's numbers (`estimator/settings.py` and the presets, of
which *filter* is the digest). More than one row of a study and seed says that it was looked at,
the numbers were changed, and it was run again.

| study | seed | filter | sets | first run | claims | that fail |
| --- | ---: | --- | --- | --- | ---: | --- |
"""


def sets() -> dict[str, list[str]]:
    """Each set of trials that is tuned on or reported, as what decides its trials."""
    from studies import (
        ablation,
        anomalies_hold_out,
        consistency,
        faults,
        implausible,
        table2,
        world,
    )
    from studies._soft_arm import soft_arm_trials

    cases = [case.trial for case in faults.fault_cases(False, 0)]
    variants = ablation.warm_cases(False, 0) + ablation.cold_cases(False, 0)
    return {
        'hold-out: filter': told(HOLD_OUT.values()),
        'hold-out: anomalies': [*DETECTOR_HOLD_OUT, *told(anomalies_hold_out.trials(False, 0))],
        'reported: table2, anomalies': told(table2.trials(False, 0)),
        'reported: table3, table4': told(soft_arm_trials(False, 0)),
        'reported: consistency': told(consistency.trials(False, 0)),
        'reported: faults': told(cases),
        'reported: implausible': told(
            case.trial for case in implausible.implausible_cases(False, 0)[0]
        ),
        'reported: ablation': told(case.trial for case in variants),
        'reported: world': told(world.trials(False, 0)),
    }


def told(trials: Iterable[Trial]) -> list[str]:
    """
    Tell what decides each trial, once, in a fixed order.

    What is as it is by default is left out, so that a trial stays the same when others may be told
    more.
    """
    usual = asdict(Trial())
    said = (
        {name: value for name, value in asdict(trial).items() if value != usual[name]}
        for trial in trials
    )
    return sorted({json.dumps(one, sort_keys=True) for one in said})


def checksums() -> str:
    """One line `digest  name` for each set."""
    return ''.join(
        f'{hashlib.sha256(json.dumps(members).encode()).hexdigest()}  {name}\n'
        for name, members in sets().items()
    )


def filter_digest() -> str:
    """Digest of every number of the filter."""
    presets = sorted(PRESETS_FOLDER.glob('*.yaml'))
    said = [said_by(path) for path in (PRESETS_FOLDER.parent / 'settings.py', *presets)]
    return hashlib.sha256(' '.join(said).encode()).hexdigest()[:8]


def sets_digest() -> str:
    """Digest of the checksums in the repository."""
    return hashlib.sha256(CHECKSUMS.read_bytes()).hexdigest()[:8]


def require_book(study: str, log: Path = LOG) -> None:
    """Raise StudyError where a reported study has no log to be written into."""
    if study not in REPORTED:
        return
    try:
        with log.open('a'):
            pass
    except OSError as error:
        raise StudyError(
            f"study '{study}' is reported, and its log {log} cannot be written "
            f'({error.strerror}): run it from a checkout, or with --quick'
        ) from None


def enter(study: str, seed: int, claims: Sequence[Claim], log: Path = LOG) -> bool:
    """
    Write a run into the log unless it is there with the same numbers of the filter.

    Returns whether the study is there with other numbers.
    """
    if study not in REPORTED:
        return False
    text = log.read_text() if log.is_file() else ''
    rows = [line for line in text.splitlines() if line.startswith(f'| {study} | {seed} |')]
    key = f'| {study} | {seed} | {filter_digest()} | {sets_digest()} |'
    if not any(row.startswith(key) for row in rows):
        failing = '; '.join(f'{one.name} {one.value:.3g}' for one in claims if not one.holds)
        row = f'{key} {date.today().isoformat()} | {len(claims)} | {failing or "none"} |\n'
        log.write_text((text or HEADING) + row)
    return any(not row.startswith(key) for row in rows)
