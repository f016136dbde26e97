"""Options of a machine with a Spark core."""

from typing import Annotated

import msgspec
from msgspec import Meta

_Limit = Annotated[float, Meta(gt=0, le=3600)]


class SparkOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a machine with a Spark core; times in seconds.

    Attributes:
        hold_off: no command is sent for so long, and a tenth more, after the core has answered behind a
            ``!``; newer firmware ignores them silently then.
        answer_timeout: without an answer to ``?queue`` for so long, the core counts as not alive.
        silence_limit: without an answer for so long, a running job is aborted and ``!`` is sent.
        stop_on_connect: send ``!`` whenever the link opens, so that nothing goes on from before.
    """

    hold_off: Annotated[float, Meta(ge=0, le=60)] = 0.5
    answer_timeout: _Limit = 1.0
    silence_limit: _Limit = 5.0
    stop_on_connect: bool = False
