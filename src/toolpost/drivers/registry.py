"""Which driver and which link a machine's configuration asks for."""

from pathlib import Path
from urllib.parse import urlsplit

from toolpost.commlog import CommLog
from toolpost.config import MachineConfig
from toolpost.drivers.base import Driver, DriverListener
from toolpost.drivers.spark.driver import SparkDriver
from toolpost.links.base import Opener


def open_driver(name: str, config: MachineConfig, comm: CommLog, listener: DriverListener) -> Driver:
    """Return the driver of a machine; it opens its link once it runs."""
    return SparkDriver(name, _opener(config), comm, listener, config.spark)


def _opener(config: MachineConfig) -> Opener:
    """Return what opens the link that `config` names; each kind is imported only where it is used."""
    if config.link == "sim":
        from toolpost.links.sim import simulated_spark_opener

        return simulated_spark_opener(config.sim)
    scheme, _, rest = config.link.partition(":")
    if scheme == "tcp":
        from toolpost.links.net import tcp_opener

        address = urlsplit(config.link)
        return tcp_opener(address.hostname or "", address.port or 0)
    if scheme == "unix":
        from toolpost.links.net import unix_opener

        return unix_opener(Path(rest))
    from toolpost.links.serial import serial_opener

    return serial_opener(Path(config.link), config.baud)
