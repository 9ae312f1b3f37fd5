"""Small plots for a terminal, out of braille dots: two columns and four rows of dots in each character."""

from __future__ import annotations

from collections.abc import Sequence

BLANK = 0x2800
DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
"""The bit of a dot, by column and row from the top."""


def sketch(
    x: Sequence[float],
    y: Sequence[float],
    *,
    columns: int,
    rows: int,
    same_scale: bool,
    plain: bool = False,
    mark: int | None = None,
) -> list[str]:
    """Return lines that show points, x to the right and y upwards.

    Args:
        x: of the points.
        y: of the points, as many.
        columns: width [characters].
        rows: height [characters]; fewer come back where the points need fewer.
        same_scale: whether a metre is as long in x as in y.
        plain: stars instead of braille, for terminals that have none.
        mark: the point with this index gets a character of its own, "o".

    """
    wide, high = 2 * columns - 1, 4 * rows - 1
    left, bottom = min(x), min(y)
    width, height = max(x) - left, max(y) - bottom
    across = wide / width if width > 0.0 else 0.0
    up = high / height if height > 0.0 else 0.0
    if same_scale:
        # A dot is about as wide as it is high: characters are twice as high as wide.
        scale = min((s for s in (across, up) if s > 0.0), default=0.0)
        across = up = scale
    needed = min(rows, int(height * up) // 4 + 1)
    cells = [[0] * columns for _ in range(needed)]
    for px, py in zip(x, y, strict=True):
        column = min(wide, round((px - left) * across))
        row = max(0, 4 * needed - 1 - round((py - bottom) * up))
        cells[row // 4][column // 2] |= DOTS[column % 2][row % 4]
    shown = [["*" if plain and cell else chr(BLANK + cell) if cell else " " for cell in line] for line in cells]
    if mark is not None:
        row = max(0, 4 * needed - 1 - round((y[mark] - bottom) * up))
        shown[row // 4][min(wide, round((x[mark] - left) * across)) // 2] = "o"
    return ["".join(line).rstrip() for line in shown]
