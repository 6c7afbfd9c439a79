"""Units of length by name, in millimetres."""

import difflib

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "inch": 25.4}
"""Millimetres per unit of length."""
NO_UNIT = "unit"
"""The name of a scene unit whose length is not known."""
_WORDS = {
    "mm": ("millimetre", "millimetres", "millimeter", "millimeters"),
    "cm": ("centimetre", "centimetres", "centimeter", "centimeters"),
    "dm": ("decimetre", "decimetres", "decimeter", "decimeters"),
    "m": ("metre", "metres", "meter", "meters"),
    "inch": ("in", "inches"),
}
_SYMBOLS = {word: symbol for symbol, words in _WORDS.items() for word in (symbol, *words)}


def unit_symbol(name: str) -> str:
    """Return the key of `MILLIMETRES` that a name such as "Centimetres" or "in" means; case does not matter.

    Raises ValueError for another name; its text has the names that are known.

    >>> unit_symbol("Centimetre"), unit_symbol("in")
    ('cm', 'inch')
    """
    plain = name.strip().casefold()
    if plain in _SYMBOLS:
        return _SYMBOLS[plain]
    close = difflib.get_close_matches(plain, _SYMBOLS, n=1)
    raise ValueError(f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(MILLIMETRES)}")


def millimetres(unit: str) -> float | None:
    """Return the length of a unit as scenes, models and assets state it: "cm", or "81.49442 mm"; None if not known.

    >>> millimetres("cm"), millimetres("81.49442 mm"), millimetres("unit")
    (10.0, 81.49442, None)
    """
    if unit in MILLIMETRES:
        return MILLIMETRES[unit]
    try:
        return read_length(unit)
    except ValueError:
        return None


def read_length(text: str) -> float:
    """Return a length such as "14cm", "5.5 in" or "0.3 metres" in millimetres.

    Raises ValueError, whose text says what was expected, for anything else.

    >>> read_length("14cm"), read_length("2 in")
    (140.0, 50.8)
    """
    plain = text.strip()
    digits = len(plain) - len(plain.lstrip("0123456789.,eE+-"))
    while digits and plain[digits - 1] in "eE":  # of a unit, not of an exponent
        digits -= 1
    try:
        number = float(plain[:digits])
        length = number * MILLIMETRES[unit_symbol(plain[digits:])]
    except ValueError:
        length = float("nan")
    if not 0.0 < length < float("inf"):
        raise ValueError(f"expected a positive length with its unit, such as 14cm, 55mm, 0.3m or 6in, found {text!r}")
    return length
