"""Which job starts, and what a reposted list means for those that wait."""

import itertools
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.core.job import Job, JobState
from toolpost.core.queue import QueueState, active, next_to_start, reconcile, state_after_load

S = JobState


def job(state=S.PENDING, seq=1, **values):
    return Job(
        seq=seq, id=f"J{seq}", machine="m", program="p", commands=3, created_us=10, state=state, **values
    )


# Which starts.


def test_the_first_pending_job_is_next_whatever_the_order():
    jobs = [job(S.PENDING, 3), job(S.PENDING_HELD, 1), job(S.COMPLETED, 0), job(S.PENDING, 2)]
    for order in itertools.permutations(jobs):
        assert next_to_start(order).seq == 2


def test_a_job_that_is_not_called_does_not_start():
    jobs = [job(seq=1, called=False), job(seq=2), job(seq=3)]
    for order in itertools.permutations(jobs):
        assert next_to_start(order).seq == 2
    assert next_to_start(jobs[:1]) is None


def test_position_goes_before_the_order_of_adding():
    jobs = [
        job(seq=1, position=5),
        job(seq=2, position=-3, called=False),
        job(seq=3, position=-2),
        job(seq=4, position=-2),
    ]
    for order in itertools.permutations(jobs):
        assert next_to_start(order).seq == 3


@pytest.mark.parametrize("called", [True, False])
@pytest.mark.parametrize("state", [S.PROCESSING, S.PROCESSING_STOPPED])
def test_a_started_job_holds_the_machine(state, called):
    jobs = [job(S.PENDING, 1), job(state, 2, called=called)]
    for order in itertools.permutations(jobs):
        assert active(order).seq == 2
        assert next_to_start(iter(order)) is None


@pytest.mark.parametrize("state", sorted(set(S) - {S.PENDING, S.PROCESSING, S.PROCESSING_STOPPED}))
def test_other_jobs_neither_start_nor_hold(state):
    assert next_to_start([job(state)]) is None
    assert active([job(state)]) is None


def test_no_jobs():
    assert next_to_start([]) is None
    assert active([]) is None


# The state.


@pytest.mark.parametrize("jobs_left", [True, False])
@pytest.mark.parametrize("automatic_transition", [True, False])
def test_a_queue_is_ready_after_a_load_only_if_it_will_load_another(jobs_left, automatic_transition):
    state = state_after_load(jobs_left=jobs_left, automatic_transition=automatic_transition)
    assert state is (QueueState.READY if jobs_left and automatic_transition else QueueState.PAUSED)


# A reposted list. Jobs are written as name and number, "a1"; what is to be added as the name only.


def waiting(text):
    return [job(seq=int(word[1:]), name=word[0], called=False) for word in text.split()]


def show(jobs):
    return " ".join(item if isinstance(item, str) else f"{item.name}{item.seq}" for item in jobs)


@pytest.mark.parametrize(
    ("jobs", "names", "shown", "order", "removed"),
    [
        pytest.param("a1 b2 c3", "a b c", "1 2 3", "a1 b2 c3", "", id="the same again"),
        pytest.param("a1 b2 c3", "c a b", "1 2 3", "c3 a1 b2", "", id="another order"),
        pytest.param("a1 b2 c3", "a c", "1 2 3", "a1 c3", "b2", id="one less"),
        pytest.param("a1 b2", "a a b", "1 2", "a1 a b2", "", id="a copy"),
        pytest.param("a1 b2", "x a b y", "1 2", "x a1 b2 y", "", id="new ones"),
        pytest.param("a1 b2", "", "1 2", "", "a1 b2", id="nothing left"),
        pytest.param("", "a a", "", "a a", "", id="nothing there"),
        pytest.param("", "", "", "", "", id="nothing at all"),
        pytest.param("a5 b2 a1", "a b a", "1 2 5", "a5 b2 a1", "", id="equal names in the queue's order"),
        pytest.param("a1 a2 a3", "a a", "1 2 3", "a1 a2", "a3", id="the last of equal names goes"),
        pytest.param("a1 b2 c3", "b", "2", "b2 a1 c3", "", id="what was not shown stays at the end"),
        pytest.param("a1 b2 c3", "b", "2 3", "b2 a1", "c3", id="of the rest only what was shown goes"),
        pytest.param("a1 b2", "", "", "a1 b2", "", id="who was shown nothing removes nothing"),
        pytest.param("a1 b2 c3", "c", None, "c3", "a1 b2", id="all were shown"),
        pytest.param("a1 b2", "b", "1 2 77", "b2", "a1", id="a job shown that is gone"),
        pytest.param("a2 a1", "a", "1", "a1 a2", "", id="an equal name of another client takes no place"),
        pytest.param("a2 a1", "a a", "1", "a1 a2", "", id="it is matched when those shown are used up"),
    ],
)
def test_reconcile(jobs, names, shown, order, removed):
    ids = None if shown is None else frozenset(f"J{number}" for number in shown.split())
    result = reconcile(waiting(jobs), names.split(), ids)
    assert (show(result.order), show(result.removed)) == (order, removed)


@given(st.data())
def test_reconcile_loses_and_doubles_nothing(data):
    names = st.sampled_from("abc")
    seqs = data.draw(st.lists(st.integers(1, 30), unique=True, max_size=8))
    jobs = [job(seq=seq, name=data.draw(names), called=False) for seq in seqs]
    posted = data.draw(st.lists(names, max_size=8))
    ids = [each.id for each in jobs] + ["gone"]
    shown = data.draw(st.none() | st.frozensets(st.sampled_from(ids)))
    given_jobs = list(jobs)

    result = reconcile(jobs, posted, shown)

    assert jobs == given_jobs
    head, tail = result.order[: len(posted)], result.order[len(posted) :]
    # Every name of the list is served, at its place.
    assert [item if isinstance(item, str) else item.name for item in head] == posted
    # Every job is somewhere, once, and is the very same.
    kept = [item for item in result.order if not isinstance(item, str)]
    assert sorted(map(id, kept + result.removed)) == sorted(map(id, jobs))
    # Only what was shown is removed; what was not stays, in its order.
    assert all(shown is None or each.id in shown for each in result.removed)
    assert all(shown is not None and each.id not in shown for each in tail)
    assert [each for each in jobs if each in tail] == tail
    assert [each for each in jobs if each in result.removed] == result.removed
    # A job is added only if all of its name are used already, and those are matched in order.
    before, listed = Counter(each.name for each in jobs), Counter(posted)
    new = Counter(item for item in head if isinstance(item, str))
    for name in "abc":
        assert new[name] == max(0, listed[name] - before[name])
        of_name = [each for each in jobs if each.name == name]
        preferred = [each for each in of_name if shown is None or each.id in shown]
        preferred += [each for each in of_name if each not in preferred]
        matched = [item for item in head if not isinstance(item, str) and item.name == name]
        assert matched == preferred[: listed[name]]


@given(st.lists(st.sampled_from("abc"), max_size=8))
def test_reposting_what_is_there_changes_nothing(names):
    jobs = [job(seq=seq, name=name, called=False) for seq, name in enumerate(names, start=1)]
    for shown in (None, frozenset(), frozenset(each.id for each in jobs)):
        result = reconcile(jobs, names, shown)
        assert (result.order, result.removed) == (jobs, [])
