"""The client library of Home Assistant, as it is published (``moonraker-api``), against a running server."""

import asyncio
from typing import Any

import aiohttp
import pytest
from moonraker_api import MoonrakerClient, MoonrakerListener
from tests.dialects.moonraker.serving import serving

# The library calls aiohttp in a way that aiohttp has since deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:float parameter 'receive_timeout':DeprecationWarning")


class Listener(MoonrakerListener):
    def __init__(self) -> None:
        self.notified: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        self.states: list[str] = []
        self.exceptions: list[BaseException | type] = []

    async def state_changed(self, state: str) -> None:
        self.states.append(state)

    async def on_exception(self, exception: type | BaseException) -> None:
        self.exceptions.append(exception)

    async def on_notification(self, method: str, data: Any) -> None:
        self.notified.put_nowait((method, data))


def test_the_queue_through_moonraker_api() -> None:
    async def run() -> None:
        listener = Listener()
        async with serving() as service, aiohttp.ClientSession() as session:
            client = MoonrakerClient(
                listener,
                "127.0.0.1",
                service.port,
                session=session,
                loop=asyncio.get_running_loop(),
                timeout=1,
            )
            assert await client.connect()
            assert await client.get_websocket_id() == {"websocket_id": 1}
            identity = {"client_name": "test", "version": "1", "type": "bot", "url": "http://test"}
            assert await client.call_method("server.connection.identify", **identity) == {"connection_id": 1}

            queue = await client.call_method("server.job_queue.post_job", filenames=["a.gcode", "b.gcode"])
            first, second = [job["job_id"] for job in queue["queued_jobs"]]
            method, [event] = await asyncio.wait_for(listener.notified.get(), 5)
            assert (method, event["action"]) == ("notify_job_queue_changed", "jobs_added")
            assert event["updated_queue"] == queue["queued_jobs"]

            queue = await client.call_method("server.job_queue.jump", job_id=second)
            assert [job["job_id"] for job in queue["queued_jobs"]] == [second, first]
            queue = await client.call_method("server.job_queue.delete_job", job_ids=[first])
            assert [job["filename"] for job in queue["queued_jobs"]] == ["b.gcode"]
            assert await client.call_method("server.job_queue.status") == queue
            assert await client.call_method("server.job_queue.jump", job_id="nope") == {
                "error": {"code": 400, "message": "Invalid job id: nope"}
            }
            # Its heartbeat is a third of its timeout: it lives only if pings are answered.
            await asyncio.sleep(0.8)
            assert client.is_connected
            assert listener.exceptions == []
            await client.disconnect()
            assert listener.states[-1] == "ws_stopped"

    asyncio.run(run())
