"""Write ``docs/lattice.svg``: blocks and padding of a small lattice, the two registrations, and the digits of a quadtree code."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from schemas.address import BlockAddress, address_of, quadcode
from schemas.lattice import Lattice

TARGET = Path(__file__).parents[1] / "lattice.svg"

INK: Final = "#1b2a38"
SOFT: Final = "#8796a5"
SAMPLES: Final = "#cfe3f3"
PADDING: Final = "#f3e3c3"
ACCENT: Final = "#c2410c"
WIDTH_PX: Final = 880
HEIGHT_PX: Final = 700


def text(x: float, y: float, words: str, *, size: int = 13, anchor: str = "start", fill: str = INK, bold: bool = False) -> str:
    """Return a line of text whose baseline begins (or is centred, or ends) at (x, y)."""
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:g}" y="{y:g}" font-size="{size}" text-anchor="{anchor}" fill="{fill}"{weight}>{words}</text>'


def box(x: float, y: float, width: float, height: float, *, fill: str = "none", stroke: str = INK, line: float = 1) -> str:
    """Return a rectangle."""
    return f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" fill="{fill}" stroke="{stroke}" stroke-width="{line:g}"/>'


def dot(x: float, y: float, radius: float, fill: str) -> str:
    """Return a filled circle."""
    return f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="{fill}"/>'


def rule(x: float, top: float, bottom: float, colour: str, dashes: str) -> str:
    """Return a dashed vertical line."""
    return f'<line x1="{x:g}" y1="{top:g}" x2="{x:g}" y2="{bottom:g}" stroke="{colour}" stroke-dasharray="{dashes}"/>'


def blocks_and_padding(left: float, top: float) -> Iterator[str]:
    """Draw all levels of a lattice, each block with its code; the part without samples in the colour of padding."""
    lattice, side = Lattice(1000, 700, 256), 64
    yield text(left, top, "Blocks and padding: a layer of 1000 × 700 samples, block side 256", bold=True)
    for level in range(lattice.levels):
        (width, height), (columns, rows) = lattice.level_size(level), lattice.block_counts(level)
        blocks = f"{columns} × {rows} blocks" if level < lattice.levels - 1 else "one block"
        yield text(left, top + 24, f"level {level}: {width} × {height} samples, {blocks}", size=12)
        yield box(left, top + 34, columns * side, rows * side, fill=PADDING, stroke="none")
        yield box(left, top + 34, width * side / lattice.block, height * side / lattice.block, fill=SAMPLES, stroke="none")
        for address in lattice.addresses(level):
            x, y = left + address.x * side, top + 34 + address.y * side
            yield box(x, y, side, side)
            code = quadcode(address, lattice.levels)
            yield text(x + side / 2, y + side / 2 + 5, code or "no code", anchor="middle", size=15 if code else 12)
        left += 292
    # The key lies below the middle level, which leaves room there.
    x, y = left - 584, top + 34 + 3 * side
    yield box(x, y - 24, 14, 12, fill=SAMPLES) + text(x + 20, y - 13, "samples", size=12)
    yield box(x + 90, y - 24, 14, 12, fill=PADDING) + text(x + 110, y - 13, "padding", size=12)


def registrations(left: float, top: float) -> Iterator[str]:
    """Draw one row of seven samples and its coarser levels, once as cells and once as vertices."""
    step, count = 48, 7
    for name, words in (("area", "samples are centres of cells"), ("point", "samples are vertices")):
        lattice = Lattice(count, 1, 2, "area" if name == "area" else "point")
        yield text(left, top, f"{name}: {words}", bold=True)
        if name == "point":
            for i, depth in ((0, 2), (2, 1), (4, 2), (6, 1)):
                yield rule(left + (i + 0.5) * step, top + 32, top + 32 + 44 * depth, SOFT, "2 3")
        for level in range(lattice.levels):
            y, spacing = top + 32 + 44 * level, step * 2**level
            colour = ACCENT if level else INK
            for i in range(lattice.level_size(level)[0]):
                if name == "area":
                    yield box(left + i * spacing, y - 11, spacing, 22, fill=SAMPLES, stroke=SOFT)
                    yield dot(left + (i + 0.5) * spacing, y, 4, colour)
                else:
                    yield dot(left + i * spacing + step / 2, y, 4, colour)
            end = left + (count + 1) * step
            yield text(end + 12, y + 4, f"level {level}", size=12)
        if name == "area":
            x = left + count * step
            yield rule(x, top + 14, top + 136, ACCENT, "5 3")
            yield text(x + 4, top + 150, "end of the source", size=11, anchor="end", fill=ACCENT)
        top += 190


def digits(left: float, top: float) -> Iterator[str]:
    """Draw the four digits, and the four blocks of Tian et al.'s example in the quadtree of three digits."""
    yield text(left, top, "Quadtree code", bold=True)
    for code in ("0", "1", "2", "3"):
        address = address_of(code, 2)
        x, y = left + 40 * address.x, top + 16 + 40 * address.y
        yield box(x, y, 40, 40, fill=SAMPLES)
        yield text(x + 20, y + 26, code, anchor="middle", size=17)
    yield text(left + 96, top + 40, "digits of the", size=12) + text(left + 96, top + 56, "four children", size=12)
    top, side, levels = top + 130, 26, 4
    marked = {address_of(code, levels) for code in ("122", "123", "300", "301")}
    yield text(left, top - 8, "122, 123, 300 and 301", size=12)
    for address in (BlockAddress(0, x, y) for y in range(8) for x in range(8)):
        x, y = left + side * address.x, top + side * address.y
        yield box(x, y, side, side, fill=SAMPLES if address in marked else "none", stroke=SOFT, line=0.7)
        if address in marked:
            yield text(x + side / 2, y + side / 2 + 4, quadcode(address, levels), anchor="middle", size=11)
    for splits, line in ((2, 1.4), (1, 2.2)):
        cell = 8 * side / 2**splits
        for number in range(2 ** (2 * splits)):
            x, y = number % 2**splits, number // 2**splits
            yield box(left + x * cell, top + y * cell, cell, cell, line=line)


def generate() -> str:
    """Return the text of the file."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {HEIGHT_PX}" font-family="Helvetica, Arial, sans-serif">',
        "<title>Blocks, padding, registration and quadtree codes</title>",
        f'<rect width="{WIDTH_PX}" height="{HEIGHT_PX}" fill="#ffffff"/>',
        *blocks_and_padding(30, 36),
        *registrations(30, 326),
        *digits(610, 326),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    TARGET.write_text(generate(), encoding="utf-8")
