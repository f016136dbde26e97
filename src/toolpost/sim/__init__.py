"""Simulated machines: real protocols on real file descriptors, with faults on demand.

A simulated machine is part of the product: ``link = "sim"`` runs one inside the server,
``toolpost sim spark`` runs one on a pseudo-terminal, and the tests and benches use both.

The parts, from the wire inwards:

- ``ports``: where a core meets a host; a pty with a symlink, or a socket pair in the process.
- ``stream``, ``pacing``: bytes in and out of one file descriptor, at a serial line's speed.
- ``lines``: bytes to lines, as the firmware's line buffer does it.
- ``spark``: the simulated Spark core: what each line does, boot, ``!`` and fault mode.
- ``options``, ``commands``: what a core is like, and what it takes for a command.
- ``execution``: the queue, and how its commands are executed in time.
- ``answers``: what is answered to signals, and when; ``timers``, ``delay`` serve it.
- ``motion``, ``replies``: where the axes are, and what the core says.
- ``faults``: faults as text (``mute:2@100``) and when each becomes due.
- ``run``: the whole thing as a process of its own.
"""
