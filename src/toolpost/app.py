"""The server put together: what is opened, in which order, and how it is let go of again."""

import asyncio
import contextlib
import logging
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
from starlette.routing import BaseRoute, Mount, Router

from toolpost.commlog import CommLog
from toolpost.config import Address, Config, machine_addresses, main_addresses, without_effect
from toolpost.dialects.moonraker.app import Moonraker, takes_forms
from toolpost.dialects.spooler.api import SpoolerApi
from toolpost.dialects.spooler.routes import spooler_routes
from toolpost.errors import StartError, StorageError
from toolpost.events import Events, FileChanged
from toolpost.http.body import BodyReader
from toolpost.http.gate import Gate
from toolpost.http.server import Listener, is_loopback
from toolpost.machine import Machine
from toolpost.shop import Shop
from toolpost.store import Store
from toolpost.store.files import Files
from toolpost.store.lock import DirectoryLock
from toolpost.telemetry import Telemetry

log = logging.getLogger(__name__)

_BODIES_AT_ONCE = 2


class App:
    """One server over one data directory.

    Args:
        config: what to serve.
        data: the data directory; made if missing.
        listen: main listeners that replace those of the configuration, or None.
    """

    def __init__(self, config: Config, data: Path, listen: list[Address] | None = None) -> None:
        self._config = config
        self._data = data
        self._main = listen or main_addresses(config.server)
        self._stop = asyncio.Event()

    def stop(self) -> None:
        """End `run`."""
        self._stop.set()

    async def run(self, ready: Callable[[str], None]) -> None:
        """Serve until `stop`.

        Args:
            ready: called with the URL of each listener that takes requests.

        Raises:
            StartError: an address or the data directory is not to be had.
            ConfigError: the configuration is wrong.
        """
        async with contextlib.AsyncExitStack() as opened:
            try:
                machines, listeners = await self._open(opened)
                for machine in machines:
                    machine.start()
            except (OSError, sqlite3.Error, msgspec.MsgspecError, StorageError) as error:
                raise StartError(f"data directory {self._data}: {error}") from None
            for listener in listeners:
                await listener.open()
                ready(listener.url)
            await self._stop.wait()
            log.info("stopping")

    async def _open(self, opened: contextlib.AsyncExitStack) -> tuple[list[Machine], list[Listener]]:
        """Open everything; `opened` closes it again in the opposite order."""
        for key in without_effect(self._config):
            log.warning("%s has no effect yet", key)
        opened.callback(DirectoryLock(self._data).close)
        store = Store(self._data)
        opened.callback(store.close)
        telemetry = Telemetry.open(self._data, self._config.telemetry)
        opened.push_async_callback(telemetry.close)
        events = Events()
        machines = {}
        for name, config in self._config.machines.items():
            comm = CommLog(self._data / "logs", name, config.log)
            opened.callback(comm.close)
            machines[name] = Machine(name, config, store, telemetry, comm, events)
        files = Files(
            self._data / "gcodes",
            self._data / "programs" / "files",
            on_change=lambda change: events.publish(FileChanged(change)),
        )
        # Jobs run from their programs; what is kept of the files only spares reading them again.
        await files.trim(set(), self._config.storage.programs_bytes)
        shop = Shop(machines, store, telemetry, files, self._config.storage.programs_bytes, self._main[0])
        moonrakers = {name: Moonraker(shop, name, events) for name in machines}
        for moonraker in moonrakers.values():
            opened.callback(moonraker.close)
        listeners = []
        for address, roots in self._addresses(shop, moonrakers):
            listener = self._listener(address, roots, store)
            opened.callback(listener.release)
            listeners.append(listener)
        opened.push_async_callback(_close_all, listeners)
        # The machines first: a client that takes its time must not keep them moving.
        opened.push_async_callback(_halt_all, list(machines.values()))
        return list(machines.values()), listeners

    def _addresses(
        self, shop: Shop, moonrakers: dict[str, Moonraker]
    ) -> Iterator[tuple[Address, list[BaseRoute]]]:
        """Yield where is listened and what is served there."""
        server = self._config.server
        bodies = BodyReader(server.max_body_bytes, server.max_body_bytes * _BODIES_AT_ONCE)

        def routes(name: str) -> list[BaseRoute]:
            failed = self._config.machines[name].spooler.failed
            spooler = spooler_routes(SpoolerApi(shop, name, failed), bodies)
            return [*spooler, *moonrakers[name].routes(bodies)]

        main = routes(shop.machines[0])
        main += [Mount(f"/machines/{name}", routes=routes(name)) for name in shop.machines]
        for address in self._main:
            yield address, main
        for name, machine in self._config.machines.items():
            for address in machine_addresses(name, machine):
                yield address, routes(name)

    def _listener(self, address: Address, roots: list[BaseRoute], store: Store) -> Listener:
        server = self._config.server
        local = is_loopback(address)
        router = Router(roots, redirect_slashes=False)
        gate = Gate(router, server, local=local, key_owner=store.keys.owner, takes_forms=takes_forms)
        listener = Listener(address, gate, server.max_connections)
        if not local:
            self._warn_of_exposure(listener.url, store)
        return listener

    def _warn_of_exposure(self, url: str, store: Store) -> None:
        networks = self._config.server.open_networks
        if networks:
            log.warning(
                "%s: ANYONE in %s can move the machines: no key is asked for there (server.open_networks)",
                url,
                ", ".join(networks),
            )
        elif not store.keys.names():
            log.warning(
                "%s: nobody can come in: there is no API key; make one with `toolpost key add NAME`", url
            )


async def _halt_all(machines: list[Machine]) -> None:
    await asyncio.gather(*(machine.halt() for machine in machines))


async def _close_all(listeners: list[Listener]) -> None:
    await asyncio.gather(*(listener.close() for listener in listeners))
