"""
Clouds as tables of text: XYZ, TXT, ASC, CSV and PTS.

The dialect is found in the file: blanks, commas, semicolons or tabs between the fields; a line of
names or none; a number of points before them or none; comments after `#` or `//`. Columns with
names are taken by their names. Without names their meaning is only taken for sure where it is:
three are x, y, z; six or seven have normals where these have length 1.
"""

from __future__ import annotations

from dataclasses import dataclass
import re

from continuum_loc.errors import MapError
from continuum_loc.formats.numbers import (
    cut_error,
    may_be_cut,
    refuse_decimal_commas,
    table_of,
    text_of,
)
from continuum_loc.formats.shapes import (
    canonical,
    Cloud,
    cloud_of,
    doubled,
    NORMAL,
    require_columns,
    UNIT,
)
import numpy as np

XYZ = ('x', 'y', 'z')
COLOUR = ('red', 'green', 'blue')
OWN = (*XYZ, *NORMAL, 'planarity')
WIDEST = 1000  # columns; programs write some twenty
VALID = (
    'x,y,z or x,y,z,nx,ny,nz or x,y,z,nx,ny,nz,planarity, or others under a first line of names'
)
_COMMENT = re.compile(r'#|//')


@dataclass
class _Table:
    """Rows of a file, on which lines they stand, and what the lines before them say."""

    rows: list[str]
    numbers: list[int]
    delimiter: str | None
    names: list[str] | None = None
    promised: int | None = None
    open_end: bool = False  # the last line has no line break

    def place(self, row: int) -> str:
        return f'line {self.numbers[row]}'


def read_pts(data: bytes, where: str) -> Cloud:
    """Read a PTS file, whose fourth column is the intensity. Raises as `read_text`."""
    return read_text(data, where, fourth='intensity')


def read_text(data: bytes, where: str, fourth: str | None = None) -> Cloud:
    """
    Read a table of text. Raises MapError with line and field.

    fourth: what the last of four columns without names is, where that is known.
    """
    table = _table(text_of(data, where), where)
    if not table.rows:
        raise MapError(f'{where}: holds no points')
    width = len(_fields(table.rows[0], table.delimiter))
    if width > WIDEST:
        raise MapError(f'{where}, {table.place(0)}: {width} columns; at most {WIDEST} are read')
    _check_first_line(table, width, where)
    names = table.names or [f'column {k + 1}' for k in range(width)]
    values = table_of(table.rows, table.numbers, names, where, table.delimiter)
    _check_count(table, where)
    guessed: list[str] = []
    if table.names is None:
        names, guessed = _meaning(values, table, where, fourth)
    if table.open_end and names[-1] in OWN and may_be_cut(table.rows, table.delimiter):
        raise cut_error(where, table.numbers[-1])
    cloud = cloud_of(dict(zip(names, values.T, strict=True)), where, place=table.place)
    return Cloud(cloud.points, cloud.normals, cloud.planarity, (*guessed, *cloud.notes))


# Lines


def _table(text: str, where: str) -> _Table:
    """Split a text into rows, without comments and blank lines."""
    commented, rows, numbers = None, [], []
    lines = text.split('\n')
    for number, line in enumerate(lines, start=1):
        content = line
        if '#' in line or '//' in line:
            content, *comment = _COMMENT.split(line, maxsplit=1)
            if not content.strip() and not rows and comment:
                commented = comment[0].strip(' #/') or commented
        if content.strip():
            rows.append(content)
            numbers.append(number)
    open_end = bool(rows) and numbers[-1] == len(lines)
    table = _Table(rows, numbers, None, open_end=open_end)
    _take_head(table, commented, where)
    return table


def _take_head(table: _Table, commented: str | None, where: str) -> None:
    """Take a line of names and a number of points off the rows, in either order."""
    for _ in range(2):
        if not table.rows:
            break
        first = table.rows[0].strip()
        if table.promised is None and re.fullmatch(r'\d+', first) and len(table.rows) != 1:
            table.promised = int(first)
        elif table.names is None and _is_head(first):
            table.names = _checked(_names(first), f'{where}, {table.place(0)}')
        else:
            break
        del table.rows[0], table.numbers[0]
    if table.rows:
        table.delimiter = _delimiter(table.rows[0])
        _clean_fields(table)
    if table.names is None and commented and table.rows and _is_head(commented):
        named = _names(commented)
        if named[:3] == list(XYZ) and len(named) == len(_fields(table.rows[0], table.delimiter)):
            table.names = named


def _is_head(line: str) -> bool:
    fields = [field.strip(' "') for field in _fields(line, _delimiter(line))]
    return not any(re.match(r'[-+.]?\d|[-+]?(nan|inf)\b', field.lower()) for field in fields)


def _names(line: str) -> list[str]:
    fields = _fields(re.sub(r'\s*[\[(]m[\])]', '', line), _delimiter(line))
    return [canonical(field.strip(' "')) for field in fields if field.strip(' "')]


def _checked(names: list[str], where: str) -> list[str]:
    if twice := doubled(names):
        raise MapError(f'{where}: {", ".join(twice)} is named twice')
    try:
        require_columns(names, where)
    except MapError:
        raise MapError(
            f'{where}: columns {",".join(names)[:200]}; needed are x, y and z, in metres, and all '
            'or none of nx, ny and nz'
        ) from None
    return names


def _delimiter(line: str) -> str | None:
    return next((mark for mark in ';\t,' if mark in line.strip()), None)


def _fields(line: str, delimiter: str | None) -> list[str]:
    return [field.strip() for field in line.strip(' \t').split(delimiter)]


def _clean_fields(table: _Table) -> None:
    """Take away what some programs add: quotes, and a delimiter at the end of every row."""
    mark = table.delimiter
    if mark is None:
        return
    if '"' in table.rows[0]:
        table.rows = [row.replace('"', '') for row in table.rows]
    if mark == '\t':
        table.rows = [row.strip() for row in table.rows]
    elif all(row.rstrip().endswith(mark) for row in table.rows):
        table.rows = [row.rstrip()[:-1] for row in table.rows]


def _check_first_line(table: _Table, width: int, where: str) -> None:
    """Refuse decimal commas that a comma or a blank between fields hides, and lines too wide."""
    fields = _fields(table.rows[0], table.delimiter)
    place = f'{where}, {table.place(0)}'
    if table.delimiter == ',' and any(len(field.split()) > 1 for field in fields):
        refuse_decimal_commas(table.rows[0].split(), place)
        raise MapError(f'{place}: fields are parted by commas here and by blanks there')
    if table.names is not None and width != len(table.names):
        # `table_of` says which line it is, and whether decimal commas would explain it.
        table_of(table.rows, table.numbers, table.names, where, table.delimiter)


def _check_count(table: _Table, where: str) -> None:
    if table.promised is not None and table.promised != len(table.rows):
        raise MapError(
            f'{where}: says {table.promised} points and '
            f'{"ends after" if len(table.rows) < table.promised else "holds"} {len(table.rows)}'
        )


# Columns without names


def _meaning(
    values: np.ndarray, table: _Table, where: str, fourth: str | None
) -> tuple[list[str], list[str]]:
    """Names of the columns of a table that has none, and a note where that was not plain."""
    width = values.shape[1]
    if width == 3:
        return list(XYZ), []
    if width == 4 and fourth:
        return [*XYZ, fourth], []
    if width in (6, 7):
        _refuse_whole_numbers(values, table, where)
        return _six_or_seven(values, table, where)
    raise MapError(f'{where}: {width} columns; valid are {VALID}')


def _six_or_seven(values, table, where):
    width = values.shape[1]
    with np.errstate(over='ignore'):
        length = np.linalg.norm(values[:, 3:6], axis=1)
    unit = np.abs(length - 1.0) <= UNIT
    colours = _are_colours(values[:, [-3, -2, -1]], unit)
    if unit.all() and not colours:
        return list(OWN[:width]), []
    if colours:
        between = ['intensity'] * (width - 6)
        return [*XYZ, *between, *COLOUR], ['the last three columns are colours, not normals']
    row = int(np.flatnonzero(~unit)[0])
    said = 'some have it, some not' if unit.any() else 'none has it, and they are no colours'
    raise MapError(
        f'{where}: columns 4 to 6 have no names, so they should be normals of length 1; {said}: '
        f'{table.place(row)} has length {length[row]:.3g}. Name the columns in a first line'
    )


def _are_colours(values: np.ndarray, unit: np.ndarray) -> bool:
    """Whole numbers of up to 16 bits that are not all 0 and 1, or fractions seldom of length 1."""
    if values.min() < 0.0 or values.max() > 65535.0:
        return False
    if (values == np.round(values)).all():
        return values.max() > 1.0
    return values.max() <= 1.0 and unit.mean() < 0.5


def _refuse_whole_numbers(values: np.ndarray, table: _Table, where: str) -> None:
    """x, y and z with decimal commas, parted by commas, are six whole numbers."""
    if table.delimiter == ',' and values.shape[1] == 6:
        if not any('.' in row or 'e' in row for row in table.rows):
            raise MapError(
                f"{where}, {table.place(0)}: '{table.rows[0].strip()[:80]}' may be three numbers "
                'with decimal commas, or six; write decimal points, or name the columns in a '
                'first line'
            )
