"""The errors of a simulated Klipper host."""


class CommandError(Exception):
    """A command or request is refused; the message goes to the client as it is."""


class InternalError(Exception):
    """A command that makes a real host stumble over itself and shut down.

    The message is what the client gets.
    """
