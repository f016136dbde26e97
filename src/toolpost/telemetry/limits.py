"""What telemetry may take of the machine it runs on."""

from typing import Annotated

import msgspec
from msgspec import Meta

_Count = Annotated[int, Meta(ge=1)]


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bounds of one telemetry store.

    Attributes:
        max_bytes: bytes on disk of database, WAL and journal together; at least 4 MiB are used.
        max_age_s: seconds after which a chunk of rows is deleted.
        tags_per_machine: reports with a tag beyond these are dropped.
        shapes_per_tag: reports with a new set of keys or kinds beyond these are dropped.
        keys_per_report: reports with more keys are not stored.
        name_chars: reports whose tag or one of whose keys is longer are not stored.
        text_chars: longer string values are stored cut to this length.
        ring_reports: latest reports kept in RAM per tag.
        pending_reports: reports that may wait for the store's thread; more are dropped.
    """

    max_bytes: _Count = 1 << 30
    max_age_s: Annotated[float, Meta(gt=0)] = 90 * 86_400.0
    tags_per_machine: _Count = 256
    shapes_per_tag: _Count = 64
    keys_per_report: _Count = 256
    name_chars: _Count = 128
    text_chars: _Count = 256
    ring_reports: _Count = 256
    pending_reports: _Count = 65_536
