import errno
import hashlib
import os
import resource
import signal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.errors import ProgramError, StorageError
from toolpost.store import programs as module
from toolpost.store.programs import ProgramStore


def store_in(tmp_path):
    return ProgramStore(tmp_path / "programs")


def files(tmp_path):
    return sorted(path.name for path in (tmp_path / "programs").iterdir())


def taken(reader, sizes):
    got = []
    while not reader.exhausted:
        part = reader.take(next(sizes))
        assert part, "an empty list before the last command"
        got += part
    return got


def endless(sizes):
    while True:
        yield from sizes


def test_a_program_is_named_by_its_hash(tmp_path):
    store = store_in(tmp_path)
    program = store.add([[b"G1 X1", b"G2"], [], [b"M2"]])
    content = b"G1 X1\nG2\nM2\n"
    assert (program.sha256, program.commands, program.size) == (hashlib.sha256(content).hexdigest(), 3, 12)
    assert files(tmp_path) == [program.sha256]
    assert (tmp_path / "programs" / program.sha256).read_bytes() == content


def test_the_same_content_is_one_file(tmp_path):
    store = store_in(tmp_path)
    assert store.add([[b"G1"], [b"G2"]]) == store.add([[b"G1", b"G2"]])
    assert len(files(tmp_path)) == 1
    assert store.add([[b"G1"]]) != store.add([[b"G2"]])


def test_a_program_of_nothing(tmp_path):
    store = store_in(tmp_path)
    program = store.add([])
    assert (program.commands, program.size) == (0, 0)
    reader = store.open(program.sha256)
    assert reader.exhausted
    assert reader.take(5) == []
    reader.close()


def test_a_program_that_is_not_there(tmp_path):
    with pytest.raises(StorageError, match="program 000000000000 is missing"):
        store_in(tmp_path).open("0" * 64)


commands = st.lists(st.binary(min_size=1, max_size=12).filter(lambda line: b"\n" not in line), max_size=60)


@given(commands, st.lists(st.integers(1, 70), min_size=1), st.integers(1, 40))
def test_any_sizes_of_takes_give_the_file(tmp_path_factory, lines, sizes, block):
    store = ProgramStore(tmp_path_factory.getbasetemp() / "shared-programs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_READ_SIZE", block)
        reader = store.open(store.add([lines]).sha256)
        assert taken(reader, endless(sizes)) == lines
        assert reader.take(1) == []
        reader.close()


@pytest.mark.parametrize("extra", [-1, 0, 1])
def test_a_file_about_as_long_as_a_read(tmp_path, extra):
    store = store_in(tmp_path)
    lines = [b"x" * 63] * (module._READ_SIZE // 64 - 1) + [b"y" * (63 + extra)]
    reader = store.open(store.add([lines]).sha256)
    assert taken(reader, endless([48])) == lines
    reader.close()


def test_a_read_that_fails_leaves_no_command_out(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_READ_SIZE", 6)
    store = store_in(tmp_path)
    lines = [b"%d" % n for n in range(10, 40)]
    reader = store.open(store.add([lines]).sha256)
    real, fails = reader._file, True

    class Failing:
        close = real.close

        def read(self, size):
            if fails:
                raise OSError(errno.EIO, "Input/output error")
            return real.read(size)

    reader._file = Failing()
    got = reader.take(2)
    assert got == lines[:2]
    assert not reader.exhausted
    for _ in range(2):
        with pytest.raises(StorageError, match="Input/output error"):
            reader.take(2)
    fails = False
    assert got + taken(reader, endless([2])) == lines
    reader.close()


def age(tmp_path, program, seconds):
    os.utime(tmp_path / "programs" / program.sha256, (seconds, seconds))
    return program.sha256


def test_trim_deletes_the_oldest_that_no_job_needs(tmp_path):
    store = store_in(tmp_path)
    names = [age(tmp_path, store.add([[b"%d" % n * 99]]), n) for n in range(10)]
    each = (tmp_path / "programs" / names[0]).stat().st_blocks * 512
    store.trim({names[0]}, 10 * each)
    assert len(files(tmp_path)) == 10, "no more than allowed"
    store.trim({names[0], names[2]}, 6 * each)
    assert files(tmp_path) == sorted([names[0], names[2], *names[7:]])


def test_trim_never_deletes_what_is_needed(tmp_path):
    store = store_in(tmp_path)
    names = [age(tmp_path, store.add([[b"%d" % n * 99]]), n) for n in range(4)]
    store.trim(set(names), 1)
    assert files(tmp_path) == sorted(names)
    store.trim({names[3]}, 1)
    assert files(tmp_path) == [names[3]]


def test_trim_spares_what_is_just_being_written(tmp_path):
    store = store_in(tmp_path)

    def blocks():
        yield [b"x" * 500]
        store.trim(set(), 1)
        yield [b"y"]

    store.add([[b"old" * 500]])
    program = store.add(blocks())
    assert files(tmp_path) == [program.sha256]


def test_the_total_is_known_after_a_restart(tmp_path):
    store = store_in(tmp_path)
    names = [age(tmp_path, store.add([[b"%d" % n * 99]]), n) for n in range(4)]
    each = (tmp_path / "programs" / names[0]).stat().st_blocks * 512
    store_in(tmp_path).trim(set(), 2 * each)
    assert files(tmp_path) == [names[3]]


def test_what_a_crash_left_over_is_removed(tmp_path):
    program = store_in(tmp_path).add([[b"G1"]])
    (tmp_path / "programs" / "0123456789abcdef.part").write_bytes(b"half")
    store_in(tmp_path)
    assert files(tmp_path) == [program.sha256]


def test_a_refused_line_leaves_nothing(tmp_path):
    def blocks():
        yield [b"G1"] * 10_000
        raise ValueError("line 7")

    store = store_in(tmp_path)
    with pytest.raises(ValueError, match="line 7"):
        store.add(blocks())
    assert files(tmp_path) == []


def test_a_full_disk_leaves_nothing(tmp_path):
    # The kernel itself refuses the write, half-way through.
    store = store_in(tmp_path)
    program = store.add([[b"G1"]])
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(StorageError, match="could not be stored"):
            store.add([[b"G1 X1"] * 1000] * 50)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert files(tmp_path) == [program.sha256]
    assert store.add([[b"G1 X1"] * 1000] * 50).commands == 50_000


@pytest.mark.parametrize("call", ["fsync", "rename"])
def test_a_disk_that_fails_at_the_end_leaves_no_part(tmp_path, monkeypatch, call):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    store = store_in(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os if call == "fsync" else module.Path, call, full)
        with pytest.raises(StorageError, match="No space left on device"):
            store.add([[b"G1"]])
    assert files(tmp_path) == []


def test_the_content_is_synced_before_it_has_its_name(tmp_path, monkeypatch):
    store = store_in(tmp_path)
    steps = []
    sync, rename = os.fsync, module.Path.rename
    monkeypatch.setattr(os, "fsync", lambda fd: steps.append("sync") or sync(fd))
    monkeypatch.setattr(module.Path, "rename", lambda a, b: steps.append("rename") or rename(a, b))
    store.add([[b"G1"]])
    assert steps == ["sync", "rename", "sync"]


@pytest.mark.parametrize("damage", [lambda data: data[:-4], lambda data: data[:-2] + b"9\n", lambda _: b""])
def test_a_program_that_is_not_what_it_was_is_not_opened(tmp_path, damage):
    store = ProgramStore(tmp_path)
    program = store.add([[b"G1 X1", b"G1 X2"]])
    path = tmp_path / program.sha256
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ProgramError, match="is damaged"):
        store.open(program.sha256)
