import errno
import os

import msgspec
import pytest

from toolpost.telemetry.journal import Block, Journal
from toolpost.telemetry.shape import Shape, ShapeDef

SHAPE = Shape(1, ShapeDef("m", "t", ("a", "b"), "ns"))


def block(n):
    return Block.of(SHAPE, SHAPE.definition, n, [n * 10, n * 10 + 3], [[n, 0.5], ["x", "y"]])


def content(path):
    journal = Journal(path)
    blocks = [block for frame in journal.replay() for block in frame]
    journal.close()
    return blocks


def test_round_trip(tmp_path):
    path = tmp_path / "j"
    journal = Journal(path)
    journal.append([block(1)])
    journal.append([block(2), block(3)])
    journal.sync()
    assert journal.size == path.stat().st_size
    journal.close()
    blocks = content(path)
    assert [b.first for b in blocks] == [1, 2, 3]
    assert blocks[0].absolute_times() == [10, 13]
    assert blocks[0].decoded_columns() == [[1, 0.5], ["x", "y"]]
    assert blocks[0].definition == SHAPE.definition


def test_torn_at_every_position(tmp_path):
    path = tmp_path / "j"
    journal = Journal(path)
    ends = [0]
    for n in range(3):
        journal.append([block(n)])
        ends.append(journal.size)
    journal.close()
    whole = path.read_bytes()
    for cut in range(len(whole) + 1):
        path.write_bytes(whole[:cut])
        frames = sum(end <= cut for end in ends) - 1
        assert [b.first for b in content(path)] == list(range(frames))
        assert path.stat().st_size == ends[frames]


def test_any_flipped_byte_ends_the_journal_there(tmp_path):
    path = tmp_path / "j"
    journal = Journal(path)
    for n in range(2):
        journal.append([block(n)])
    journal.close()
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        assert [b.first for b in content(path)] == ([] if at < len(whole) // 2 else [0])


def test_appends_after_a_torn_end_can_be_read(tmp_path):
    path = tmp_path / "j"
    journal = Journal(path)
    journal.append([block(1)])
    journal.close()
    with path.open("ab") as file:
        file.write(b"\x99\x00\x00\x00torn")
    journal = Journal(path)
    assert len(list(journal.replay())) == 1
    journal.append([block(2)])
    journal.close()
    assert [b.first for b in content(path)] == [1, 2]


def test_failed_write_leaves_no_part(tmp_path, monkeypatch):
    path = tmp_path / "j"
    journal = Journal(path)
    journal.append([block(1)])
    write = os.write

    def half(file, data):
        if len(data) > 10:
            return write(file, bytes(data[:10]))
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda file, data: half(file, data) if file > 2 else 0)
        patch.setattr(os, "ftruncate", _full)
        with pytest.raises(OSError, match="full"):
            journal.append([block(2)])
        with pytest.raises(OSError, match="full"):
            journal.append([block(2)])
    journal.append([block(3)])
    journal.close()
    assert [b.first for b in content(path)] == [1, 3]


def _full(*_):
    raise OSError(errno.ENOSPC, "full")


def test_rewrite(tmp_path, monkeypatch):
    path = tmp_path / "j"
    journal = Journal(path)
    for n in range(5):
        journal.append([block(n)])
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", _full)
        with pytest.raises(OSError, match="full"):
            journal.rewrite([block(7)])
    journal.append([block(5)])
    assert [b.first for b in content(path)] == [0, 1, 2, 3, 4, 5]
    journal.rewrite([block(7), block(8)])
    journal.append([block(9)])
    journal.close()
    assert [b.first for b in content(path)] == [7, 8, 9]
    assert list(tmp_path.iterdir()) == [path]


def test_valid_frame_of_something_else_ends_the_journal(tmp_path):
    path = tmp_path / "j"
    journal = Journal(path)
    journal.append([block(1)])
    frame = journal._encoder
    journal._encoder = type("Odd", (), {"encode": lambda *_: msgspec.msgpack.encode({"a": 1})})()
    journal.append([block(2)])
    journal._encoder = frame
    journal.close()
    assert [b.first for b in content(path)] == [1]
