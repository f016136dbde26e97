import itertools

import msgspec
import pytest

from toolpost.core.job import Job, JobState, Reason, TransitionError, after_restart

S = JobState
ALLOWED = {
    S.PENDING: {S.PENDING, S.PENDING_HELD, S.PROCESSING, S.CANCELED, S.ABORTED},
    S.PENDING_HELD: {S.PENDING, S.CANCELED, S.ABORTED},
    S.PROCESSING: {S.PENDING, S.PROCESSING_STOPPED, S.CANCELED, S.ABORTED, S.COMPLETED},
    S.PROCESSING_STOPPED: {S.PROCESSING, S.CANCELED, S.ABORTED},
    S.CANCELED: set(),
    S.ABORTED: set(),
    S.COMPLETED: set(),
}
ENDED = {S.CANCELED, S.ABORTED, S.COMPLETED}
STEPS = list(itertools.product(S, S))


def job(state=S.PENDING, seq=1, **values):
    return Job(
        seq=seq, id=f"J{seq}", machine="m", program="p", commands=3, created_us=10, state=state, **values
    )


def test_every_state_has_its_row():
    assert set(ALLOWED) == set(S)


@pytest.mark.parametrize(("before", "after"), [(a, b) for a, b in STEPS if b in ALLOWED[a]])
def test_allowed(before, after):
    old = job(before)
    new = old.to(after, Reason.RUNNING, 99, "words")
    assert (new.state, new.reason, new.detail) == (after, Reason.RUNNING, "words")
    assert (new.seq, new.id, new.program, new.created_us) == (old.seq, old.id, old.program, old.created_us)
    assert new.ended_us == (99 if after in ENDED else None)
    assert new.started_us == (99 if after is S.PROCESSING else None)
    assert old.state is before


@pytest.mark.parametrize(("before", "after"), [(a, b) for a, b in STEPS if b not in ALLOWED[a]])
def test_forbidden(before, after):
    with pytest.raises(TransitionError, match=f"J1 is {before} and cannot become {after}"):
        job(before).to(after, Reason.RUNNING, 99)


@pytest.mark.parametrize("state", S)
def test_ended(state):
    assert job(state).ended is (state in ENDED)


def test_the_first_start_counts():
    stopped = job().to(S.PROCESSING, Reason.RUNNING, 20).to(S.PROCESSING_STOPPED, Reason.LINK_LOST, 30)
    assert stopped.to(S.PROCESSING, Reason.RUNNING, 40).started_us == 20


def test_a_start_that_could_not_be_recorded_is_none():
    back = job().to(S.PROCESSING, Reason.RUNNING, 20).to(S.PENDING, Reason.STORAGE_FAILED, 30)
    assert back.started_us is None
    assert back.to(S.PROCESSING, Reason.RUNNING, 40).started_us == 40


@pytest.mark.parametrize("load_on_startup", [True, False])
@pytest.mark.parametrize("state", S)
def test_after_restart(state, load_on_startup):
    old = job(state, started_us=5)
    new = after_restart(old, load_on_startup=load_on_startup, at_us=50)
    if state is S.PROCESSING:
        assert (new.state, new.reason) == (S.PROCESSING_STOPPED, Reason.HOST_RESTARTED)
    elif state is S.PENDING and not load_on_startup:
        assert (new.state, new.reason) == (S.PENDING_HELD, Reason.HOST_RESTARTED)
    else:
        assert new is old


@pytest.mark.parametrize("state", S)
def test_no_restart_starts_a_job(state):
    for load_on_startup in (True, False):
        new = after_restart(job(state), load_on_startup=load_on_startup, at_us=50)
        assert new.state is not S.PROCESSING


@pytest.mark.parametrize("load_on_startup", [True, False])
@pytest.mark.parametrize("state", S)
def test_after_restart_a_called_job_of_the_queue_is_back_in_it(state, load_on_startup):
    old = job(state, name="a.gcode", called=True, position=7, detail="words")
    new = after_restart(old, load_on_startup=load_on_startup, at_us=50)
    if state is S.PROCESSING:
        assert (new.state, new.reason) == (S.PROCESSING_STOPPED, Reason.HOST_RESTARTED)
    elif state is S.PENDING:
        assert new == msgspec.structs.replace(old, called=False, reason=Reason.QUEUE_POSITION)
        assert new.position == 7, "at its place"
    else:
        assert new is old


@pytest.mark.parametrize("load_on_startup", [True, False])
@pytest.mark.parametrize("name", ["", "a.gcode"])
def test_after_restart_what_waits_in_the_queue_goes_on_waiting(name, load_on_startup):
    old = job(name=name, called=False, reason=Reason.QUEUE_POSITION)
    assert after_restart(old, load_on_startup=load_on_startup, at_us=50) is old
