"""Names of sensors and of parts of a state: they may have slashes inside, for what belongs together (`range/1`)."""

from __future__ import annotations


def check_name(name: str, what: str) -> str:
    """The name itself. ValueError where a part between slashes is empty: `range/1/` is the same entity as `range/1`,
    but another sensor."""
    one = "/".join(part for part in name.split("/") if part.strip())
    if one != name:
        remedy = f"call it {one!r}" if one else "give it a name"
        raise ValueError(f"{what} {name!r}: a name has no empty part before, between or after slashes; {remedy}")
    return name
