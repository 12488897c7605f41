"""Scores of trials, by hand."""

from hmasd_jax.search.score import read_evaluations, scores_so_far
from tests.helpers.runs import write_run


def test_the_untrained_policy_does_not_count(tmp_path):
    run = write_run(tmp_path / "run", [[1, 0, 0.5], [1, 0.2]])
    assert read_evaluations(run, 2) == ("success", [[0, 0.5], [0.2]])
    assert read_evaluations(run, 3)[1] == [[0, 0.5], [0.2], []]


def test_seeds_that_train_at_once():
    # Means of the last two: seed 0 has 0, 0.5, 1; seed 1 has 1, 1, 0.5.
    evaluations = [[0, 1, 1], [1, 1, 0]]
    scores = list(scores_so_far(evaluations, at_once=2, total=3, last=2))
    assert scores == [(1, 0.5), (2, 0.75), (3, 0.75)]


def test_a_slower_seed_is_waited_for():
    assert list(scores_so_far([[0, 1, 1], [1]], at_once=2, total=3, last=1)) == [(1, 0.5)]
    assert list(scores_so_far([[0, 1, 1], []], at_once=2, total=3, last=1)) == []


def test_groups_follow_each_other():
    # Seed 0 ends with 1. The second group then counts beside it.
    evaluations = [[0, 1], [0.5, 0]]
    scores = list(scores_so_far(evaluations, at_once=1, total=2, last=1))
    assert scores == [(1, 0.0), (2, 1.0), (3, 0.75), (4, 0.5)]
    begun = list(scores_so_far([[0, 1], [0.5], []], at_once=1, total=2, last=1))
    assert begun == scores[:3]


def test_an_unfinished_group_ends_the_scores():
    assert list(scores_so_far([[0], [1, 1]], at_once=1, total=2, last=1)) == [(1, 0.0)]
