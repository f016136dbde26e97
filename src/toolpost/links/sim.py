"""Links to a simulated machine in this process."""

import asyncio

from toolpost.errors import LinkError
from toolpost.links.base import Link, LinkListener, Opener
from toolpost.links.net import socket_link
from toolpost.sim.faults import Fault
from toolpost.sim.options import SimulatedSparkOptions
from toolpost.sim.ports import SimulatedSpark


def simulated_spark_opener(options: SimulatedSparkOptions) -> Opener:
    """Return an opener of a simulated Spark core, which lives on when the link is lost."""
    core: SimulatedSpark | None = None

    async def open_simulated(listener: LinkListener) -> Link:
        nonlocal core
        if core is None:
            core = SimulatedSpark(
                asyncio.get_running_loop(),
                options,
                baud=options.baud,
                faults=map(Fault.parse, options.faults),
            )
        try:
            sock = core.connect()
        except OSError as error:
            raise LinkError(f"sim: {error.strerror}") from None
        return socket_link(sock, listener)

    return open_simulated
