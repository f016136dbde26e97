"""The computer, the configuration, and what Toolpost has none of (external_api/machine.md, server.md).

Clients do not begin to work before all of these are answered (dialects/moonraker.md 3.1).
"""

import asyncio
import time
from collections import deque
from typing import Any, Final

from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.host import Reading, describe_host, read_host
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.events import Event
from toolpost.shop import Shop

NOTIFICATION = "notify_proc_stat_update"

INTERVAL: Final = 1.0
"""Seconds between two looks at how busy the computer is."""

KEPT: Final = 30
"""Looks that a client is told of when it asks."""

_FRESH: Final = INTERVAL / 2


class SystemMethods:
    """The computer and the configuration, for the clients of one machine.

    Args:
        shop: knows the configuration.
        machine: name of the machine.
        connections: are told how busy the computer is.
    """

    def __init__(self, shop: Shop, machine: str, connections: Connections) -> None:
        self._shop = shop
        self._machine = machine
        self._connections = connections
        self._host: dict[str, Any] | None = None
        self._load = _Load()
        self._watch: asyncio.Task[None] | None = None

    def methods(self) -> list[Method]:
        """Return the methods."""
        handlers = {
            "machine.system_info": self.system_info,
            "machine.proc_stats": self.proc_stats,
            "server.config": self.config,
            "server.webcams.list": self.webcams,
            "server.announcements.list": self.announcements,
            "server.temperature_store": self.temperature_store,
            "server.gcode_store": self.gcode_store,
        }
        return [
            Method(name, ("GET", f"/{name.replace('.', '/')}"), NoParams, handler)
            for name, handler in handlers.items()
        ]

    async def system_info(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``machine.system_info``. Toolpost manages no services, and looks for no virtualization."""
        if self._host is None:
            self._host = await asyncio.to_thread(describe_host)
        info = {
            **self._host,
            "sd_info": {},
            "virtualization": {"virt_type": "none", "virt_identifier": "none"},
            "network": {},
            "canbus": {},
            "provider": "none",
            "available_services": [],
            "service_state": {},
            "instance_ids": {"moonraker": "moonraker", "klipper": "klipper"},
        }
        return {"system_info": info}

    async def proc_stats(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``machine.proc_stats``."""
        self._begin_watch()
        await self._load.look()
        return {
            "moonraker_stats": list(self._load.samples),
            "throttled_state": None,
            **self._load.latest,
            "system_uptime": self._load.uptime,
            "websocket_connections": len(self._connections),
        }

    async def config(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.config``: what there is of it in Moonraker's words; no path and no secret is in it."""
        queue = self._shop.queue_config(self._machine)
        address = self._shop.address
        config = {
            "server": {} if address is None else {"host": address.host, "port": address.port},
            "job_queue": {
                "load_on_startup": queue.load_on_startup,
                "automatic_transition": queue.automatic_transition,
                "job_transition_delay": queue.job_transition_delay,
                "job_transition_gcode": queue.job_transition_gcode,
            },
            # An upload that is to be printed waits in the queue if the machine is not free (transfer.py).
            "file_manager": {"queue_gcode_uploads": True},
        }
        return {"config": config, "orig": config, "files": []}

    async def webcams(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.webcams.list``: there are none."""
        return {"webcams": []}

    async def announcements(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.announcements.list``: Toolpost fetches no news."""
        return {"entries": [], "feeds": []}

    async def temperature_store(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.temperature_store``: by heater, of which a Spark core has none."""
        return {}

    async def gcode_store(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.gcode_store``.

        Empty: the lines that went to and fro are in the comm log, on disk among those of the jobs; reading
        that back for a page that is loaded would cost more than a console that begins empty.
        """
        return {"gcode_store": []}

    def event(self, event: Event) -> None:  # noqa: ARG002
        """Begin to tell how busy the computer is, if somebody has come."""
        self._begin_watch()

    def _begin_watch(self) -> None:
        if len(self._connections) and (self._watch is None or self._watch.done()):
            self._watch = asyncio.create_task(self._tell(), name=f"{self._machine}: load")

    async def _tell(self) -> None:
        """Tell all connections every `INTERVAL`, until there are none."""
        # What is told is the usage since the look before; that first one may be long ago, or there was none.
        await self._load.look()
        await asyncio.sleep(INTERVAL)
        while count := len(self._connections):
            await self._load.look()
            told = {"moonraker_stats": self._load.samples[-1], **self._load.latest}
            self._connections.notify(NOTIFICATION, {**told, "websocket_connections": count})
            await asyncio.sleep(INTERVAL)


class _Load:
    """How busy the computer is. The usage of processors and network is that since the look before.

    Attributes:
        samples: the latest looks at this process, the newest last.
        latest: the latest look at the computer.
        uptime: of the computer, seconds.
    """

    def __init__(self) -> None:
        self.samples: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self.latest: dict[str, Any] = {}
        self.uptime: float | None = None
        self._reading: Reading | None = None
        self._lock = asyncio.Lock()

    async def look(self) -> None:
        """Have a look now, but for one that was had a moment ago, however many ask."""
        async with self._lock:
            if self._reading is None or time.monotonic() - self._reading.clock > _FRESH:
                self._take(await asyncio.to_thread(read_host))

    def _take(self, new: Reading) -> None:
        old = self._reading or new
        self._reading = new
        elapsed = new.clock - old.clock
        self.samples.append(
            {
                "time": new.time,
                "cpu_usage": _percent(new.used - old.used, elapsed),
                "memory": new.rss,
                "mem_units": "kB",
            }
        )
        network = {}
        for name, counters in new.network.items():
            before = old.network.get(name, counters)
            moved = sum(counters[key] - before[key] for key in ("rx_bytes", "tx_bytes"))
            network[name] = {**counters, "bandwidth": _rate(moved, elapsed)}
        usage = {}
        for name, (busy, total) in new.processors.items():
            busy_before, total_before = old.processors.get(name, (busy, total))
            usage[name] = _percent(busy - busy_before, total - total_before)
        self.latest = {
            "cpu_temp": new.temperature,
            "network": network,
            "system_cpu_usage": usage,
            "system_memory": new.memory,
        }
        self.uptime = new.uptime


def _rate(change: float, elapsed: float) -> float:
    # Counters may begin anew, as those of an interface that is plugged in again.
    return round(max(0.0, change) / elapsed, 2) if elapsed > 0 else 0.0


def _percent(change: float, elapsed: float) -> float:
    return _rate(100 * change, elapsed)
