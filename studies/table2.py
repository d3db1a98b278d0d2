"""Table II of the localisation paper: scenes S0-S9, three trajectories each, map of S0."""

from __future__ import annotations

from pathlib import Path

from continuum_loc.offline.claims import at_most, Claim, write_study
from continuum_loc.offline.error_tables import condition_table, mean, trial_rows
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.offline.trials import Trial
from studies._paper_figures import side_by_side
from studies.support.campaign import Outcome, run_campaign
from studies.support.split import HOLD_OUT, is_hold_out, require_unseen
from studies.support.worlds import by_world, in_worlds, named, told

SCENES = tuple(f'S{number}' for number in range(10))
TRAJECTORIES = ('t1', 't2', 't3')
_FULL, _S4 = (
    ('0.78 ± 0.48', '0.99 ± 0.65', '0.96 ± 0.48', '0.98 ± 0.48'),
    ('0.61 ± 0.34', '0.74 ± 0.38', '0.96 ± 0.46', '0.98 ± 0.45'),
)
PAPER = {
    'S0': _FULL,
    'S1': _FULL,
    'S2': ('0.78 ± 0.47', '1.00 ± 0.64', '0.96 ± 0.49', '0.98 ± 0.48'),
    'S3': _FULL,
    'S4': _S4,
    'S5': ('0.73 ± 0.43', '0.94 ± 0.58', '0.96 ± 0.48', '0.98 ± 0.48'),
    'S6': ('0.77 ± 0.47', '0.98 ± 0.64', '0.96 ± 0.48', '0.98 ± 0.48'),
    'S7': _S4,
    'S8': ('0.76 ± 0.44', '0.96 ± 0.60', '0.96 ± 0.49', '0.98 ± 0.48'),
    'S9': ('0.77 ± 0.47', '0.98 ± 0.64', '0.96 ± 0.48', '0.98 ± 0.48'),
}


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Run all trials in every world and judge them.

    `quick`: six seconds of one trajectory in two scenes, with coarser links.
    """
    outcomes = run_campaign(in_worlds(trials(quick, seed)), out, jobs)
    claims, tables = [], {}
    for world, members in by_world(outcomes, lambda one: one.trial).items():
        claims += told(judge(members), world)
        tables[named('table2', world)] = condition_table(
            members, 'scene', lambda outcome: outcome.trial.scene, PAPER
        )
    write_study(
        out,
        claims,
        seed=seed,
        settings={'trials': [outcome.trial for outcome in outcomes]},
        tables={**tables, 'trials': trial_rows(outcomes)},
        extra={
            'quick': quick,
            'hold_out': HOLD_OUT['engine'],
            'failed': {outcome.trial.name: outcome.error for outcome in outcomes if outcome.error},
        },
    )
    write_study_report(
        out,
        'Table II: the engine',
        claims,
        {f'Errors by scene: {name}': table for name, table in tables.items()},
        outcomes,
        pictures=side_by_side(out, outcomes),
    )
    return claims


def trials(quick: bool, seed: int) -> list[Trial]:
    """Three trials in each scene, all with the map of S0."""
    if quick:
        return [
            Trial('engine', scene, 't2', 'S0', seed=seed, duration=6.0) for scene in ('S0', 'S8')
        ]
    return [
        Trial('engine', scene, trajectory, 'S0', profile='full', seed=seed)
        for scene in SCENES
        for trajectory in TRAJECTORIES
    ]


def judge(outcomes: list[Outcome]) -> list[Claim]:
    """Judge the bounds, over every trial but the hold-out that the filter was tuned on."""
    judged = [outcome for outcome in outcomes if not is_hold_out(outcome.trial)]
    require_unseen([outcome.trial for outcome in judged])
    by_scene = {
        scene: [outcome for outcome in judged if outcome.trial.scene == scene]
        for scene in dict.fromkeys(outcome.trial.scene for outcome in judged)
    }
    claims = []
    for scene, members in by_scene.items():
        claims += [
            at_most(
                f'{scene}: translation MAE', mean(members, 'translation_mae_m', 100.0), 'cm', 0.2
            ),
            at_most(f'{scene}: rotation MAE', mean(members, 'rotation_mae_deg'), 'deg', 0.3),
        ]
    return (
        claims
        + _against_s0(by_scene)
        + [
            at_most(
                'trials that failed', sum(outcome.summary is None for outcome in outcomes), '', 0
            )
        ]
    )


def _against_s0(by_scene: dict[str, list[Outcome]]) -> list[Claim]:
    """No scene more than 15 % worse than S0, over the same trajectories."""
    claims = []
    for scene, members in by_scene.items():
        shared = {outcome.trial.trajectory for outcome in by_scene['S0']}
        paired = [outcome for outcome in members if outcome.trial.trajectory in shared]
        for kind, key in (('translation', 'translation_mae_m'), ('rotation', 'rotation_mae_deg')):
            ratio = mean(paired, key) / mean(by_scene['S0'], key)
            if scene != 'S0':
                claims.append(at_most(f'{scene}: {kind} MAE against S0', ratio, 'ratio', 1.15))
    return claims
