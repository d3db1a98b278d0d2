"""Numbers written as text: read strictly, and complained about by line and field."""

from __future__ import annotations

from collections.abc import Sequence
import re

from continuum_loc.errors import MapError
import numpy as np

CHUNK = 10_000  # rows that are searched together for one that is wrong
MOST_COUNTED = 1000  # wrong rows
_DECIMAL_COMMA = re.compile(r'[-+]?\d*,\d+(?:[eE][-+]?\d+)?')
_FRACTION = re.compile(r'[-+]?\d*\.(\d+)(?:[eE][-+]?(\d+))?')
_WORD_CHARACTER = re.compile(r'[\w.+-]$')


def text_of(data: bytes, where: str) -> str:
    """Decode a text file (UTF-8, UTF-16 by its mark, else Latin-1), its lines ended by LF."""
    if data[:2] in (b'\xff\xfe', b'\xfe\xff'):
        text = data.decode('utf-16', errors='replace')
    else:
        try:
            text = data.decode('utf-8-sig')
        except UnicodeDecodeError:
            text = data.decode('latin-1')
    if '\0' in text:
        raise MapError(f'{where}: not a text file: it holds bytes that no text has')
    return text.replace('\r\n', '\n').replace('\r', '\n')


def table_of(
    rows: Sequence[str],
    numbers: Sequence[int],
    names: Sequence[str],
    where: str,
    delimiter: str | None = None,
) -> np.ndarray:
    """
    Read rows of text as numbers (N, len(names)).

    numbers: on which line of the file each row stands. delimiter: None for any blanks. Raises
    MapError naming the first line and field that are no number, and how many lines are like it.
    """
    if not rows:
        return np.empty((0, len(names)))
    table = _parsed(rows, names, delimiter)
    if table is None:
        raise MapError(f'{where}, {_complaint(rows, numbers, names, delimiter)}')
    return table


def _parsed(rows, names, delimiter) -> np.ndarray | None:
    try:
        table = np.loadtxt(rows, delimiter=delimiter, comments=None, ndmin=2, dtype=np.float64)
    except ValueError:
        return None
    return table if table.shape == (len(rows), len(names)) else None


def may_be_cut(rows: Sequence[str], delimiter: str | None = None) -> bool:
    """
    Tell whether the last number of a text that does not end with a line break may lack digits.

    It cannot where every number of the last column has as many decimals as it.
    """
    if not rows or not _WORD_CHARACTER.search(rows[-1]):
        return False
    shapes = {_shape(row.split(delimiter)[-1].strip()) for row in rows}
    return None in shapes or len(shapes) > 1 or len(rows) < 2


def index_may_be_cut(text: str, most: int) -> bool:
    """
    Tell whether an index that ends a text may lack digits.

    It cannot where every longer one that begins like it is above `most`.
    """
    digits = text.lstrip('-')
    return digits.isdigit() and 0 < 10 * int(digits) <= most


def cut_error(where: str, number: int) -> MapError:
    """Make the error of a file whose end is no line break, where that leaves a number open."""
    return MapError(
        f'{where}, line {number}: the file ends within this line, and its last number may lack '
        'digits; if the file is whole, add a line break at its end'
    )


def refuse_decimal_commas(fields: Sequence[str], where: str) -> None:
    """Raise MapError naming the first field that is a number with a decimal comma."""
    for position, field in enumerate(fields, start=1):
        if _DECIMAL_COMMA.fullmatch(field):
            raise MapError(f'{where}, field {position}: {_said_of_comma(field)}')


def _said_of_comma(field: str) -> str:
    return f"'{field}' has a decimal comma; write a decimal point"


def _shape(text: str) -> tuple[int, int] | None:
    found = _FRACTION.fullmatch(text)
    return (len(found[1]), len(found[2] or '')) if found else None


def _complaint(rows, numbers, names, delimiter) -> str:
    wrong = []
    for start in range(0, len(rows), CHUNK):
        part = slice(start, start + CHUNK)
        if _parsed(rows[part], names, delimiter) is not None:
            continue
        for number, row in zip(numbers[part], rows[part], strict=True):
            if (fault := _fault(row.split(delimiter), names, delimiter)) is not None:
                wrong.append((number, row, fault))
        if len(wrong) > MOST_COUNTED:
            break
    if not wrong:  # what NumPy refuses and Python does not, such as digits of another script
        return f'line {numbers[0]}: not a table of plain numbers'
    number, row, fault = wrong[0]
    count = f'more than {MOST_COUNTED}' if len(wrong) > MOST_COUNTED else f'{len(wrong)}'
    return f"line {number}{fault}, in '{row.strip()[:80]}' ({count} such lines)"


def _fault(fields: list[str], names: Sequence[str], delimiter: str | None) -> str | None:
    fields = [field.strip() for field in fields]
    whole = all(re.fullmatch(r'[-+]?\d+', field) for field in fields)
    if delimiter == ',' and whole and len(fields) == 2 * len(names):
        return f', field 1 ({names[0]}): {_said_of_comma(",".join(fields[:2]))}'
    for position, field in enumerate(fields, start=1):
        if _is_number(field):
            continue
        name = f' ({names[position - 1]})' if position <= len(names) else ''
        if _DECIMAL_COMMA.fullmatch(field):
            return f', field {position}{name}: {_said_of_comma(field)}'
        return f", field {position}{name}: '{field[:40]}' is no number"
    if len(fields) != len(names):
        return f': expected {len(names)} numbers ({",".join(names)[:80]}), got {len(fields)}'
    return None


def _is_number(text: str) -> bool:
    if '_' in text:
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True
