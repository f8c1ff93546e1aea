"""Text panels whose links move the time cursor.

Rerun follows a link to a moment of what a server holds, `…/dataset/ID?segment_id=ID#when=time@3.5s`; within a
recording, `recording://…` selects an entity and nothing more. But a viewer is the server of the files that it opened,
under an address that is known then. So a panel's links name an entity, which any viewer selects, and as their title the
time; our viewer puts its own address in their place (`moving`).
"""

from __future__ import annotations

import re
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

_LINK = re.compile(r'\(recording:/(/[^\s)]+) "at ([\d.-]+) s"\)')


def link(text: str, entity: str, time: float) -> str:
    """A link, in markdown, that goes to a time (s), to the nanosecond, and selects an entity, or where its name is not
    for links what it is part of."""
    if not re.fullmatch(r"[\w/.-]+", entity):
        entity = "/" + entity.split("/")[1]
    return f'[→ {text}](recording:/{entity} "at {time:.9f} s")'


def panel(origin: str, name: str, markdown: str) -> rrb.TextDocumentView:
    """A view of an entity's text that can be given another, with other links."""
    document = rr.TextDocument(markdown, media_type="text/markdown")
    return rrb.TextDocumentView(origin=origin, name=name, overrides={origin: [document]})


def moving(blueprint: dict[str, Any], server: str, store_id: str) -> dict[str, Any] | None:
    """A blueprint's panels with links to the moments of a recording (`Recording:DATASET:SEGMENT`) on a server; None
    where it has no links."""
    _, dataset, segment = store_id.split(":")
    moment = rf"({server}/dataset/{dataset}?segment_id={segment}#selection=\1&when=time@\2s)"
    found = {}
    for path, fields in blueprint.items():
        text = fields.get("TextDocument", {}).get("text", "")
        if (moved := _LINK.sub(moment, text)) != text:
            found[path] = fields | {"TextDocument": fields["TextDocument"] | {"text": moved}}
    return blueprint | found if found else None
