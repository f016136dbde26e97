"""A simulated Klipper host: the API socket of ``klippy.py``, with faults on demand.

What it does was measured on a real host (git 84104bb); no code of Klipper is in it.

The parts, from the socket inwards:

- ``host``: the process: binds the socket, boots, restarts, dies, has faults.
- ``connection``, ``endpoints``: one client's frames, and what each method does.
- ``status``: queries and subscriptions, on one common tick.
- ``printer``: one life of the machine, from boot to restart, put together.
- ``gcode``, ``parsing``: lines to commands, one at a time.
- ``motion``, ``heaters``, ``idle``, ``extras``: what the commands act on.
- ``sdcard``, ``files``, ``print_stats``, ``pausing``: printing a file.
- ``settings``: the machine's configuration as clients read it.
- ``faults``: faults as text (``disconnect:2``).
"""

from toolpost.sim.klippy.host import SimulatedKlippy
from toolpost.sim.klippy.options import KlippyOptions

__all__ = ["KlippyOptions", "SimulatedKlippy"]
