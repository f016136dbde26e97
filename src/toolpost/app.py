"""The server put together: what is opened, in which order, and how it is let go of again."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from starlette.routing import BaseRoute, Mount, Router

from toolpost.commlog import CommLog
from toolpost.config import Address, Config, machine_addresses, main_addresses, without_effect
from toolpost.dialects.spooler.api import SpoolerApi
from toolpost.dialects.spooler.routes import spooler_routes
from toolpost.events import Events
from toolpost.http.body import BodyReader
from toolpost.http.gate import Gate, parse_networks
from toolpost.http.server import Listener, is_loopback
from toolpost.machine import Machine
from toolpost.shop import Shop
from toolpost.store import Store
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
        self._undo: list[Callable[[], object]] = []

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
        try:
            listeners, machines = await self._open()
            try:
                for machine in machines:
                    machine.start()
                for listener in listeners:
                    await listener.open()
                    ready(listener.url)
                await self._stop.wait()
                log.info("stopping")
            finally:
                await asyncio.gather(*(listener.close() for listener in listeners))
                await asyncio.gather(*(machine.stop() for machine in machines))
        finally:
            for undo in reversed(self._undo):
                result = undo()
                if asyncio.iscoroutine(result):
                    await result

    async def _open(self) -> tuple[list[Listener], list[Machine]]:
        lock = DirectoryLock(self._data)
        self._undo.append(lock.close)
        parse_networks(self._config.server)
        for key in without_effect(self._config):
            log.warning("%s has no effect yet", key)
        store = Store(self._data)
        self._undo.append(store.close)
        telemetry = Telemetry.open(self._data, self._config.telemetry)
        self._undo.append(telemetry.close)
        events = Events()
        machines = {
            name: Machine(
                name,
                config,
                store,
                telemetry,
                CommLog(self._data / "logs", name, config.log),
                events,
            )
            for name, config in self._config.machines.items()
        }
        shop = Shop(machines, store, telemetry, self._config.storage.programs_bytes)
        try:
            listeners = self._listeners(shop, store)
        except BaseException:
            for machine in machines.values():
                await machine.stop()
            raise
        return listeners, list(machines.values())

    def _listeners(self, shop: Shop, store: Store) -> list[Listener]:
        server = self._config.server
        bodies = BodyReader(server.max_body_bytes, server.max_body_bytes * _BODIES_AT_ONCE)

        def routes(name: str) -> list[BaseRoute]:
            failed = self._config.machines[name].spooler.failed
            return list(spooler_routes(SpoolerApi(shop, name, failed), bodies))

        def listener(address: Address, roots: list[BaseRoute]) -> Listener:
            local = is_loopback(address)
            if not local:
                self._warn_of_exposure(address, store)
            router = Router(roots, redirect_slashes=False)
            gate = Gate(router, server, local=local, key_owner=store.keys.owner)
            opened = Listener(address, gate, server.max_connections)
            self._undo.append(opened.release)
            return opened

        main = routes(shop.machines[0])
        main += [Mount(f"/machines/{name}", routes=routes(name)) for name in shop.machines]
        listeners = [listener(address, main) for address in self._main]
        for name, machine in self._config.machines.items():
            listeners += [listener(a, routes(name)) for a in machine_addresses(name, machine)]
        return listeners

    def _warn_of_exposure(self, address: Address, store: Store) -> None:
        networks = self._config.server.open_networks
        if networks:
            log.warning(
                "%s: ANYONE in %s can move the machines: no key is asked for there (server.open_networks)",
                address,
                ", ".join(networks),
            )
        elif not store.keys.names():
            log.warning(
                "%s: nobody can come in: there is no API key; make one with `toolpost key add NAME`",
                address,
            )
