"""Documents of which a part is written by a script: what lies between two markers."""

from pathlib import Path


def with_content(target: Path, begin: str, end: str, content: str) -> str:
    """Return the text of ``target`` with ``content`` between its markers ``begin`` and ``end``; raises ValueError if one is missing."""
    text = target.read_text(encoding="utf-8")
    before, _, rest = text.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise ValueError(f"{target}: one of the two markers is missing")
    return f"{before}{begin}\n\n{content}\n\n{end}{after}"
