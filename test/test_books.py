"""The books: sets are what their checksums say, and a study is not reported twice in silence."""

from continuum_loc.errors import StudyError
from continuum_loc.offline.claims import at_most
import pytest
from studies.support import books

CLAIMS = [at_most('too far', 2.0, 'cm', 1.0), at_most('near', 0.5, 'cm', 1.0)]


def test_what_is_tuned_on_and_what_is_reported_is_what_the_repository_says():
    assert books.checksums() == books.CHECKSUMS.read_text()


def test_no_trial_is_both_tuned_on_and_claimed_of():
    """Tables show the hold-outs among all others; the sets of the rest have none of them."""
    sets = books.sets()
    held = set(sets['hold-out: filter'])
    for name in ('consistency', 'faults', 'ablation', 'world'):
        assert not held & set(sets[f'reported: {name}'])


def test_a_run_is_entered_once_and_again_with_other_numbers_of_the_filter(tmp_path, monkeypatch):
    log = tmp_path / 'reported.md'
    assert not books.enter('table2', 0, CLAIMS, log)
    assert not books.enter('table2', 0, CLAIMS, log)
    assert not books.enter('table2', 1, CLAIMS, log)
    monkeypatch.setattr(books, 'filter_digest', lambda: 'another1')
    assert books.enter('table2', 0, [], log)
    rows = [line for line in log.read_text().splitlines() if line.startswith('| table2')]
    assert len(rows) == 3
    assert rows[0].endswith('| 2 | too far 2 |') and rows[2].endswith('| 0 | none |')


def test_a_reported_study_without_a_log_is_refused_and_others_need_none(tmp_path):
    nowhere = tmp_path / 'no' / 'reported.md'
    with pytest.raises(StudyError, match='run it from a checkout, or with --quick'):
        books.require_book('table2', nowhere)
    books.require_book('flights', nowhere)
    assert books.enter('flights', 0, CLAIMS, nowhere) is False
