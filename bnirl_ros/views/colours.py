"""One colour for each rank, told apart by colour-blind readers as well."""

from __future__ import annotations

Colour = tuple[float, float, float]
"""Red, green and blue, each 0-1, as sRGB."""

UNEXPLAINED: Colour = (0.68, 0.68, 0.68)
"""Colour of observations that no subgoal explains."""

INK: Colour = (0.11, 0.13, 0.16)
"""Colour of writing."""

# Taken from the published colour-blind-safe palettes of Okabe & Ito (2008), Paul Tol (2021) and
# IBM: blue, vermilion and green, then always the one farthest from those before it in OKLab, the
# nearest of normal vision and simulated protanopia and deuteranopia counting. A test measures it.
_PALETTE = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#88CCEE",
    "#332288",
    "#DDCC77",
    "#648FFF",
    "#E69F00",
    "#994F00",
    "#785EF0",
    "#56B4E9",
    "#5D3A9B",
)

# After the palette come its tints, then its shades: (towards, how far).
_VARIATIONS: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1.0, 0.45), (0.0, 0.4))


def colour_of(rank: int) -> Colour:
    """Colour of the subgoal of this rank, 0 for none; the first 36 have one of their own."""
    if rank == 0:
        return UNEXPLAINED
    turn, place = divmod(rank - 1, len(_PALETTE))
    towards, share = _VARIATIONS[turn % len(_VARIATIONS)]
    code = _PALETTE[place]
    red, green, blue = (
        (1.0 - share) * int(code[start : start + 2], 16) / 255 + share * towards
        for start in (1, 3, 5)
    )
    return red, green, blue


def writing_on(colour: Colour) -> Colour:
    """Ink or white, whichever stands out more (relative luminance of WCAG 2)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return (1.0, 1.0, 1.0) if luminance < 0.26 else INK
