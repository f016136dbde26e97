"""Whatever people do with a queue, and whenever it crashes, it is what a plain list would be."""

import asyncio
import contextlib
from collections import Counter
from itertools import count
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.queue.floor import Floor
from toolpost.config import QueueConfig
from toolpost.errors import ToolpostError

NAMES = st.lists(st.sampled_from("abc"), max_size=4)
NUMBERS = st.integers(0, 1000)
"""What is drawn must not rest on what a machine has done: the next run may be quicker."""


class Model:
    """A queue as a list of ids, the job that holds the machine, and how jobs have ended."""

    def __init__(self, automatic, load_on_startup):
        self.automatic = automatic
        self.load_on_startup = load_on_startup
        self.queue = []
        self.names = {}
        self.active = None
        self.stopped = False  # the active job was found after a crash and waits for a person
        self.ended = {}
        self.ready = False
        self.pause_requested = False

    def post(self, ids):
        self.queue += ids
        if self.automatic and self.active and not self.pause_requested and self.queue:
            self.ready = True

    def remove(self, ids):
        for job_id in ids:
            if job_id in self.queue:
                self.queue.remove(job_id)
                self.ended[job_id] = "canceled"
        self.ready = self.ready and bool(self.queue)

    def jump(self, job_id):
        self.queue.remove(job_id)
        self.queue.insert(0, job_id)

    def start(self):
        self.pause_requested = False
        if not self.queue:
            self.ready = False
        elif self.active:
            self.ready = True
        else:
            self.load()

    def load(self):
        self.active = self.queue.pop(0)
        self.ready = self.automatic and bool(self.queue)

    def pause(self):
        self.pause_requested = True
        self.ready = False

    def end(self, state):
        if self.active:
            self.ended[self.active] = state
        self.active = None
        self.stopped = False
        if state == "completed" and self.ready:
            self.load()
        elif state != "completed":
            self.ready = False

    def crash(self):
        self.stopped = self.active is not None
        if self.load_on_startup and self.queue and not self.active:
            self.load()

    @property
    def state(self):
        return "ready" if self.ready else "paused"


class QueueMachine(RuleBasedStateMachine):
    """Operations on a real queue and a `Model`. Each job has one command, which no other job has."""

    def __init__(self):
        super().__init__()
        self.folder = TemporaryDirectory()
        self.loop = asyncio.Runner()
        self.numbers = count(1)
        self.shop = None
        self.did = []

    def run(self, coroutine):
        return self.loop.run(coroutine)

    def told(self):
        """What a failure shows: hypothesis cannot replay what a machine has done."""
        return self.did, vars(self.model), self.shop.state, self.shop.ids, self.shop.history

    @initialize(automatic=st.booleans(), load_on_startup=st.booleans(), gcode=st.sampled_from(["", "M5"]))
    def begin(self, automatic, load_on_startup, gcode):
        options = QueueConfig(
            automatic_transition=automatic,
            load_on_startup=load_on_startup,
            job_transition_delay=0.0,
            job_transition_gcode=gcode,
        )

        async def main():
            self.shop = Floor(Path(self.folder.name), options)
            self.shop.free = {b"M5"}
            await self.shop.ready()
            self.shop.permit(0)

        self.model = Model(automatic, load_on_startup)
        self.run(main())

    def write(self, names):
        """Give each file a new content; jobs that wait already must not care."""
        for name in set(names):
            self.shop.write(f"{name}.gcode", f"G1 X{next(self.numbers)}")

    def line_of(self, job):
        program = self.shop.directory / "programs" / job.program
        return program.read_text().strip()

    async def settle(self):
        shop = self.shop
        for _ in range(2):
            await shop.until(lambda: shop.machine.driver.state.alive)
            await shop.until(lambda: shop.running or shop.machine.driver.ready or self.held())
            await shop.settled()

    def held(self):
        """Whether the core still has commands of before a crash."""
        return self.shop.core.queue_length > 0

    # What people do.

    @rule(names=NAMES)
    def post(self, names):
        self.did.append(("post", names))

        async def main():
            new = []
            for name in names:  # one by one: each has a content of its own
                self.write([name])
                new += await self.shop.post(name)
                self.model.post(new[-1:])
            self.model.names.update(zip(new, names, strict=True))

        self.run(main())

    @rule(names=NAMES)
    def post_together(self, names):
        self.did.append(("post_together", names))

        async def main():
            self.write(names)
            new = await self.shop.post(*names)
            self.model.post(new)
            self.model.names.update(zip(new, names, strict=True))

        self.run(main())

    @rule(seed=NUMBERS, more=NAMES)
    def repost(self, seed, more):
        """The whole list again in another order, with some left out and some doubled (Mainsail)."""
        self.did.append(("repost", seed, more))
        names = [self.model.names[job_id] for job_id in self.model.queue]
        random = Random(seed)
        random.shuffle(names)
        names = names[: random.randint(0, len(names))] + more

        async def main():
            self.write(names)
            new = await self.shop.post(*names, replace=True, shown=frozenset(self.model.queue))
            fresh, old, order = iter(new), list(self.model.queue), []
            for name in names:
                found = next((job_id for job_id in old if self.model.names[job_id] == name), None)
                if found is None:
                    found = next(fresh)
                    self.model.names[found] = name
                else:
                    old.remove(found)
                order.append(found)
            assert not list(fresh)
            self.model.queue = [*order, *old]
            self.model.remove(old)
            self.model.post([])

        self.run(main())

    @rule(numbers=st.lists(NUMBERS, max_size=3))
    def remove(self, numbers):
        self.did.append(("remove", numbers))
        known = [*self.model.names, "0123"]
        job_ids = [known[-1 - number % len(known)] for number in numbers]
        self.run(self.shop.remove(*job_ids))
        self.model.remove(job_ids)

    @rule()
    def remove_all(self):
        self.did.append(("remove_all",))
        self.run(self.shop.remove_all())
        self.model.remove(list(self.model.queue))

    @rule(number=NUMBERS)
    def jump(self, number):
        self.did.append(("jump", number))
        if not self.model.queue:
            return
        job_id = self.model.queue[number % len(self.model.queue)]
        self.run(self.shop.jump(job_id))
        self.model.jump(job_id)

    @rule(times=st.sampled_from([1, 5]))
    def start(self, times):
        self.did.append(("start", times))

        async def main():
            await asyncio.gather(*(self.shop.start() for _ in range(times)))
            await self.settle()

        self.run(main())
        self.model.start()

    @rule()
    def pause(self):
        self.did.append(("pause",))
        self.run(self.shop.pause())
        self.model.pause()

    @rule()
    def cancel(self):
        self.did.append(("cancel",))

        async def main():
            await self.shop.cancel()
            await self.settle()

        self.run(main())
        self.model.end("canceled")
        self.model.ready = False

    # What the machine does.

    @rule()
    def complete(self):
        self.did.append(("complete",))
        if not self.model.active or self.model.stopped:
            return

        async def main():
            shop, job_id = self.shop, self.model.active
            await shop.until(lambda: self.held() or shop.machine.driver.state.machine_commands)
            shop.permit(1)
            await shop.until(lambda: shop.history[job_id] == "completed done")
            await self.settle()

        self.run(main())
        self.model.end("completed")

    @rule()
    def reboot(self):
        self.did.append(("reboot",))

        async def main():
            self.shop.inject("reboot")
            self.shop.permit(0)
            if self.model.active and not self.model.stopped:
                await self.shop.until(lambda: self.shop.history[self.model.active].startswith("aborted"))
            await self.settle()

        self.run(main())
        if self.model.active and not self.model.stopped:
            self.model.end("aborted")

    # Crashes.

    async def restart(self):
        await self.shop.crash()
        self.shop.open()
        assert self.shop.state in {"ready", "paused"}
        await self.settle()

    @rule()
    def crash(self):
        self.did.append(("crash",))
        if self.held() and not self.model.active:
            return  # what was left of a job may still hold the machine up
        self.run(self.restart())
        self.model.crash()

    @rule(
        operation=st.sampled_from(["post", "start", "pause", "remove", "jump", "cancel", "complete"]),
        turns=st.integers(0, 25),
    )
    def crash_in(self, operation, turns):
        """A crash a few turns of the loop after something was asked; if that was acknowledged, it holds."""
        self.did.append(("crash_in", operation, turns))
        model, shop = self.model, self.shop
        if (operation == "jump" and not model.queue) or (operation == "complete" and not model.active):
            return

        async def main():
            calls = {
                "post": lambda: shop.post("a"),
                "start": shop.start,
                "pause": shop.pause,
                "remove": lambda: shop.remove(*model.queue[:1]),
                "jump": lambda: shop.jump(model.queue[-1]),
                "cancel": shop.cancel,
                "complete": self.let_go,
            }
            self.write("a")
            task = asyncio.create_task(calls[operation]())
            for _ in range(turns):
                await asyncio.sleep(0)
            acknowledged = task.done() and task.exception() is None
            if not task.done():
                task.cancel()
            new = task.result() if acknowledged and operation == "post" else []
            await shop.crash()
            shop.permit(0)
            shop.open()
            with contextlib.suppress(asyncio.CancelledError, ToolpostError):
                await task
            found, first = shop.ids, shop.state
            history = {job_id: state.split()[0] for job_id, state in shop.history.items()}

            assert set(model.names) | set(new) <= set(history), "an acknowledged job is missing"
            assert all(history[job_id] == state for job_id, state in model.ended.items())
            assert first in {"ready", "paused"}
            assert first == "paused" or found
            known = [job_id for job_id in found if job_id in model.names]
            order = list(model.queue)
            if operation == "jump" and (acknowledged or known[:1] == order[-1:]):
                order = [order[-1], *order[:-1]]
            assert known == [job_id for job_id in order if job_id in known], "the order has changed"
            gone = set(order) - set(known)
            if operation == "remove":
                assert gone <= set(order[:1])
                assert all(history[job_id] == "canceled" for job_id in gone)
                assert gone or not acknowledged or not order
            else:
                assert len(gone) <= 1
                assert all(history[job_id] == "processing-stopped" for job_id in gone)
            if acknowledged and operation in {"pause", "cancel"}:
                assert first == "paused"
            if acknowledged and operation == "cancel":
                assert model.active is None or history[model.active] == "canceled"

            # Go on from what is there.
            for job_id in found:
                model.names.setdefault(job_id, "a")
            model.queue = found
            held = [job_id for job_id, state in history.items() if state == "processing-stopped"]
            model.active = held[0] if held else None
            ends = {"canceled", "aborted", "completed"}
            model.ended = {job_id: state for job_id, state in history.items() if state in ends}
            model.ready = first == "ready"
            model.pause_requested = shop.machine.queue._pause_requested
            await self.settle()
            model.crash()

        self.run(main())

    async def let_go(self):
        self.shop.permit(1)

    # What always holds.

    @invariant()
    def it_is_what_the_model_says(self):
        if self.shop is None:
            return
        shop, model = self.shop, self.model
        assert (shop.ids, shop.running) == (model.queue, model.active), self.told()
        assert shop.state == model.state, self.told()
        history = {job_id: state.split()[0] for job_id, state in shop.history.items()}
        assert {job_id: history[job_id] for job_id in model.ended} == model.ended
        assert (
            set(model.names)
            == set(history)
            == set(model.queue) | set(model.ended) | {job_id for job_id in [model.active] if job_id}
        )
        self.run(shop.store.settings.set("edm", "barrier", 0))
        stored = {job.id: job for job in shop.store.jobs.load("edm", 10_000)}
        assert {job_id: job.state.value for job_id, job in stored.items()} == history, self.told()
        waiting = [job for job in stored.values() if job.id in model.queue]
        assert [job.id for job in sorted(waiting, key=lambda job: (job.position, job.seq))] == model.queue

    @invariant()
    def nothing_runs_twice(self):
        if self.shop is None:
            return
        started = Counter(self.line_of(job) for job in self.shop.jobs if job.started_us is not None)
        received = Counter(line for line in self.shop.received if line != "M5")
        assert received <= started, self.told()
        assert sum(job.state.value.startswith("processing") for job in self.shop.jobs) <= 1

    def teardown(self):
        async def main():
            await self.shop.stop()
            self.shop.close()

        if self.shop is not None:
            self.run(main())
        self.loop.close()
        self.folder.cleanup()


TestQueue = QueueMachine.TestCase
TestQueue.settings = settings(
    max_examples=40,
    stateful_step_count=25,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
