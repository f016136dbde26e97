"""The state of a machine: independent values, never one enum.

The names of `Execution` are MTConnect's; "unknown" is a value of its own.
"""

import enum

import msgspec


class LinkState(enum.StrEnum):
    """Whether bytes can go to and fro."""

    OFFLINE = "offline"
    CONNECTING = "connecting"
    ONLINE = "online"
    FAULT = "fault"


class Execution(enum.StrEnum):
    """What the machine does (MTConnect, Execution)."""

    UNAVAILABLE = "unavailable"
    READY = "ready"
    ACTIVE = "active"
    ALARM = "alarm"


class MachineState(msgspec.Struct, frozen=True, kw_only=True):
    """A machine at one moment.

    Attributes:
        link: state of the link.
        execution: what the machine itself does.
        waiting_commands: commands given to Toolpost outside a job that have not been sent yet.
        machine_commands: commands sent that the machine has not reported as executed.
        job_sent: commands of the running job that have been sent.
    """

    link: LinkState
    execution: Execution
    waiting_commands: int = 0
    machine_commands: int = 0
    job_sent: int = 0

    @property
    def alive(self) -> bool:
        """Whether the machine answers."""
        return self.link is LinkState.ONLINE
