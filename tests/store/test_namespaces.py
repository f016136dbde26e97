"""What clients keep: nested keys, bounds, and a disk that is full or a process that ends."""

import asyncio
import time

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import UNSET

from tests.store.storing import fill, free, opened, run
from toolpost.errors import InvalidRequestError, NotAcceptedError, StorageError
from toolpost.store import namespaces as bounds
from toolpost.store.namespaces import NamespaceStore


def plain(value):
    """A value as a client reads it."""
    return value if value is UNSET else msgspec.json.decode(msgspec.json.encode(value))


def using(tmp_path, main):
    async def opening():
        with opened(tmp_path / "d.db") as database:
            await main(NamespaceStore(database), database)

    run(opening)


def test_values_outlive_the_process(tmp_path):
    async def write(store, _):
        await store.put("ui", ["settings", "console", "on"], True)
        await store.put("ui", ["settings", "theme"], {"color": "ü", "sizes": [1, 2.5, None]})
        await store.put("ui", ["a.gcode"], "text")
        await store.put("other", ["n"], None)

    async def read(store, _):
        settings = {"console": {"on": True}, "theme": {"color": "ü", "sizes": [1, 2.5, None]}}
        assert store.names() == ["other", "ui"]
        assert plain(store.get("ui")) == {"settings": settings, "a.gcode": "text"}
        assert plain(store.get("ui", ["settings"])) == settings
        assert plain(store.get("ui", ["settings", "theme", "sizes"])) == [1, 2.5, None]
        assert store.get("ui", ["a.gcode"]) == msgspec.Raw(b'"text"')
        assert plain(store.get("other", ["n"])) is None
        for path in ([], ["x"], ["n", "x"]):
            assert store.get("nope", path) is UNSET
        for path in (["x"], ["settings", "x"], ["a.gcode", "x"], ["settings", "theme", "sizes", "0"]):
            assert store.get("ui", path) is UNSET

    using(tmp_path, write)
    using(tmp_path, read)


def test_deleting_returns_the_value_and_ends_an_empty_namespace(tmp_path):
    async def main(store, _):
        await store.put("ui", ["a", "b", "c"], [1])
        await store.put("ui", ["a", "d"], 2)
        assert plain(await store.delete("ui", ["a", "b", "c"])) == [1]
        for path in (["a", "b", "c"], ["a", "d", "x"], ["x"], ["x", "y"]):
            assert await store.delete("ui", path) is UNSET
        assert plain(store.get("ui")) == {"a": {"b": {}, "d": 2}}
        assert plain(await store.delete("ui", ["a"])) == {"b": {}, "d": 2}
        assert store.names() == []
        assert store.get("ui") is UNSET
        assert await store.delete("ui", ["a"]) is UNSET

    using(tmp_path, main)


def test_nothing_is_lost_to_a_key_that_leads_through_a_value(tmp_path):
    async def main(store, _):
        await store.put("ui", ["a", "b"], 5)
        for path, where in ((["a", "b", "c"], "a.b"), (["a", "b", "c", "d"], "a.b")):
            with pytest.raises(InvalidRequestError, match=f"key: what is at '{where}' is no object"):
                await store.put("ui", path, 1)
        assert plain(store.get("ui")) == {"a": {"b": 5}}

    using(tmp_path, main)


@pytest.mark.parametrize(
    ("namespace", "path", "message"),
    [
        ("", ["a"], "namespace: must have 1 to 128 characters"),
        ("n" * 129, ["a"], "namespace: must have 1 to 128 characters"),
        ("n", ["a", ""], "key: must have no empty part"),
        ("n", ["a"] * 17, "key: must have at most 16 parts"),
        ("n", ["a" * 1000, "b" * 25], "key: must have at most 1024 characters"),
    ],
)
def test_a_key_that_can_not_be_is_refused_by_all(tmp_path, namespace, path, message):
    async def main(store, _):
        with pytest.raises(InvalidRequestError, match=message):
            store.get(namespace, path)
        with pytest.raises(InvalidRequestError, match=message):
            await store.put(namespace, path, 1)
        with pytest.raises(InvalidRequestError, match=message):
            await store.delete(namespace, path)
        assert store.names() == []

    using(tmp_path, main)


def test_a_key_must_be_there_to_change_anything(tmp_path):
    async def main(store, _):
        for call in (store.put("n", [], {}), store.delete("n", [])):
            with pytest.raises(InvalidRequestError, match="key: must not be empty"):
                await call

    using(tmp_path, main)


def nested(depth):
    value = 1
    for number in range(depth):
        value = [value] if number % 2 else {"k": value}
    return value


def test_values_are_bounded_in_size_and_depth(tmp_path):
    async def main(store, _):
        longest = "x" * (bounds.MAX_VALUE - 2)
        await store.put("n", ["a"], longest)
        await store.put("n", ["b", "c"], longest[:-100])
        for path, value in ((["a"], longest + "x"), (["b", "d"], "x" * 200), (["b", "c"], longest)):
            with pytest.raises(InvalidRequestError, match="value: must be at most 1048576 bytes"):
                await store.put("n", path, value)
        deep = nested(bounds.MAX_DEPTH)
        await store.put("n", [*"klmnopqrstuvwxyz"], deep)
        assert plain(store.get("n", [*"klmnopqrstuvwxyz"])) == deep
        for value in (nested(bounds.MAX_DEPTH + 1), [1, nested(500)]):
            with pytest.raises(InvalidRequestError, match="value: must be nested at most 64 deep"):
                await store.put("n", ["e"], value)
        for value in (nested(100_000), "\ud800", {"\ud800": 1}):
            with pytest.raises(InvalidRequestError, match="value: cannot be stored"):
                await store.put("n", ["e"], value)
        assert store.get("n", ["e"]) is UNSET

    using(tmp_path, main)


def test_all_together_are_bounded_and_what_makes_room_is_always_let_in(tmp_path):
    async def main(store, _):
        value = "x" * (bounds.MAX_VALUE - 2)
        for number in range(15):
            await store.put("big", [f"k{number}"], value)
        await store.put("big", ["k"], value[:-2000])
        for namespace, key in (("big", ["l"]), ("small", ["l"]), ("big", ["k", "m"])):
            with pytest.raises((NotAcceptedError, InvalidRequestError)):
                await store.put(namespace, key, value[:3000])
        with pytest.raises(NotAcceptedError, match="would hold more than 16777216 bytes"):
            await store.put("big", ["k"], value)
        await store.put("big", ["k0"], value)
        begin = time.monotonic()
        whole = store.get("big")
        assert time.monotonic() - begin < 0.5, "a whole namespace does not hold up the loop"
        assert len(plain(whole)) == 16
        await store.delete("big", ["k1"])
        await store.put("small", ["l"], value[:3000])

    using(tmp_path, main)


def test_namespaces_and_items_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(bounds, "MAX_NAMESPACES", 3)
    monkeypatch.setattr(bounds, "MAX_ITEMS", 5)

    async def main(store, _):
        await asyncio.gather(*(store.put(name, ["a"], 1) for name in "xyz"))
        with pytest.raises(NotAcceptedError, match="there are 3 namespaces"):
            await store.put("w", ["a"], 1)
        await asyncio.gather(*(store.put("x", [key], 1) for key in "bc"))
        with pytest.raises(NotAcceptedError, match="there are 5 items"):
            await store.put("x", ["d"], 1)
        await store.put("x", ["a"], 2)
        await store.put("x", ["b"], {})
        await store.delete("y", ["a"])
        await store.put("w", ["a"], 1)
        assert store.names() == ["w", "x", "z"]

    using(tmp_path, main)


def test_a_full_disk_keeps_the_old_value(tmp_path):
    async def main(store, database):
        await store.put("n", ["a", "b"], 1)
        await fill(database)
        with pytest.raises(StorageError):
            await store.put("n", ["a", "c"], "x" * 20_000)
        assert plain(store.get("n")) == {"a": {"b": 1}}
        await free(database)
        await store.put("n", ["a", "c"], 2)
        assert plain(store.get("n")) == {"a": {"b": 1, "c": 2}}

    using(tmp_path, main)


keys = st.sampled_from(["a", "b", "c", "a.b", "ü", "\x00", '"'])
values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**40), 10**40) | st.text(st.characters(codec="utf-8")),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=8,
)
steps = st.lists(st.tuples(st.lists(keys, min_size=1, max_size=3), st.just(UNSET) | values), max_size=12)


def model_step(model, path, value):
    """Set or delete in a plain dict; whether it can be done."""
    inner = model
    for part in path[:-1]:
        if value is UNSET and part not in inner:
            return False
        inner = inner.setdefault(part, {})
        if not isinstance(inner, dict):
            return False
    if value is UNSET:
        return inner.pop(path[-1], UNSET) is not UNSET
    inner[path[-1]] = value
    return True


@given(steps=steps)
@settings(max_examples=25, deadline=None)
def test_it_does_as_a_dict_does(tmp_path_factory, steps):
    async def main(store, _):
        model = {}
        for path, value in steps:
            tried = msgspec.json.decode(msgspec.json.encode(model))
            done = model_step(tried, path, plain(value))
            if value is UNSET:
                assert (await store.delete("n", path) is not UNSET) == done
            elif done:
                await store.put("n", path, value)
            else:
                with pytest.raises(InvalidRequestError):
                    await store.put("n", path, value)
            model = tried if done else model
            assert plain(store.get("n")) == (model or UNSET)

    using(tmp_path_factory.mktemp("model"), main)
