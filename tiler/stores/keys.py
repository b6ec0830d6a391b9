"""What a key is, the same for every store."""

from schemas.errors import NotFoundError


def check_key(location: str, key: str) -> list[str]:
    """Return the parts of ``key``; raises NotFoundError if it is no plain relative path of visible names.

    So no key leads out of a store, none means two things, and what is hidden (``.x``: locks, unfinished files) is out of reach.
    """
    if "\0" in key or not is_key(key):
        raise NotFoundError(f"{location}: {key!r} is not a key of a store")
    return key.split("/")


def is_key(key: str) -> bool:
    """Whether a listed name is a key: no part of it is hidden or empty."""
    framed = f"/{key}/"
    return "//" not in framed and "/." not in framed
