"""
Typed settings read from YAML: one way to load them, one way to complain about them.

Every YAML file of the package (robot, plant, estimator, scene) is a `Settings` subclass. A key
that does not exist is refused with the nearest valid name; a value out of range is refused with
its place and its line.
"""

from __future__ import annotations

from collections.abc import Callable
import difflib
from pathlib import Path
import re
from typing import Annotated, Any, get_args, TypeVar

from continuum_loc.errors import SettingsError
from continuum_loc.yaml_files import read_yaml, write_yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    field_validator,
    ValidationError,
    ValidationInfo,
)

LONGEST_ERROR = 500  # characters of each
MOST_ERRORS = 10  # that are told of a file at once
LONGEST_NAME = 100  # characters; a name becomes part of a file's, which may have 255


class Settings(BaseModel):
    """Base of all typed settings: immutable; unknown keys and what is not finite are errors."""

    model_config = ConfigDict(
        extra='forbid', frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False
    )

    @field_validator('*', mode='before')
    @classmethod
    def _no_truth_for_a_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse `true` where a number is asked for; pydantic would take it for 1."""
        kinds = _kinds(cls.model_fields[info.field_name].annotation)
        given = value if isinstance(value, (list, tuple)) else (value,)
        if kinds & {int, float} and bool not in kinds:
            if any(isinstance(one, bool) for one in given):
                raise ValueError(f'a number is needed, not a truth value (got {value!r})')
        return value


def _kinds(annotation: Any) -> set[Any]:
    """Find all types in an annotation, those within `tuple[...]`, `... | None` and so on."""
    inner = get_args(annotation)
    return set().union(*map(_kinds, inner)) if inner else {annotation}


def check_name(name: str) -> str:
    """
    Return a name of a robot, ring, sensor or profile.

    Names become parts of file names, topics, frames and pages. Raises ValueError for one in which
    a path or markup could hide.
    """
    if not re.fullmatch(r'[A-Za-z0-9_-][A-Za-z0-9_.-]*', name):
        raise ValueError(
            f'{name!r} is no name: use letters, digits, `_`, `-` and `.`, the first not a `.`'
        )
    if len(name) > LONGEST_NAME:
        raise ValueError(
            f"'{name[:20]}...' has {len(name)} characters; a name has at most {LONGEST_NAME}"
        )
    return name


Name = Annotated[str, AfterValidator(check_name)]

S = TypeVar('S', bound=Settings)


def live(default: Any, **rest: Any) -> Any:
    """Describe a field that may change while the node runs."""
    return Field(default, json_schema_extra={'live': True}, **rest)


def load_settings(model: type[S], path: str | Path) -> S:
    """
    Read a YAML file into `model`.

    Raises SettingsError naming the file, the key, its line and the valid values.
    """
    document = read_yaml(path)
    data = {} if document.data is None else document.data
    return parse_settings(model, data, where=str(path), line_of=document.line_of)


def load_bundled(model: type[S], folder: Path, name_or_path: str | Path, what: str) -> S:
    """
    Load settings from the package's `folder/NAME.yaml`, or from a YAML file of one's own.

    what: what it is, for the error. Raises SettingsError listing the names that there are.
    """
    path = Path(name_or_path)
    if path.suffix.lower() in ('.yaml', '.yml'):
        return load_settings(model, path)
    bundled = folder / f'{name_or_path}.yaml'
    if not bundled.is_file():
        names = ', '.join(sorted(file.stem for file in folder.glob('*.yaml')))
        raise SettingsError(f"no {what} '{name_or_path}': give a .yaml file, or one of {names}")
    return load_settings(model, bundled)


def parse_settings(
    model: type[S],
    data: Any,
    where: str = 'settings',
    line_of: Callable[[tuple], int | None] = lambda place: None,
) -> S:
    """
    Validate a mapping into `model`.

    where: starts each line of the error; line_of: of a key's place in the file, where there is
    one.
    """
    if not isinstance(data, dict):
        raise SettingsError(f'{where}: expected a mapping of keys, got {type(data).__name__}')
    try:
        return model.model_validate(data)
    except ValidationError as error:
        found = _causes(error.errors())
        lines = [
            f'{where}: {_explain(model, item)[:LONGEST_ERROR]}{_in_line(line_of(item["loc"]))}'
            for item in found[:MOST_ERRORS]
        ]
        if len(found) > MOST_ERRORS:
            lines.append(f'{where}: and {len(found) - MOST_ERRORS} more')
        raise SettingsError('\n'.join(lines)) from None


def dump_settings(settings: Settings, path: str | Path) -> None:
    """Write settings as YAML that `load_settings` reads back to an equal object."""
    write_yaml(settings.model_dump(mode='json'), path)


def _causes(items: list[dict]) -> list[dict]:
    """Leave out that a list is too short, where that is so because of its refused items."""
    return [
        item
        for item in items
        if item['type'] != 'too_short'
        or not any(_is_inside(other['loc'], item['loc']) for other in items)
    ]


def _is_inside(place: tuple, outer: tuple) -> bool:
    return len(place) > len(outer) and place[: len(outer)] == outer


def _in_line(number: int | None) -> str:
    return '' if number is None else f' [line {number}]'


def _explain(model: type[Settings], item: dict) -> str:
    place = '.'.join(str(part) for part in item['loc']) or '(top level)'
    if item['type'] == 'value_error':  # our own validators, which say themselves what they got
        message = str(item['ctx']['error'])
        return f'{place}: {message}' if item['loc'] else message
    if item['type'] != 'extra_forbidden':
        got = item.get('input')
        # Of a whole mapping or list, the place says more than its content.
        said = '' if isinstance(got, (dict, list)) and len(got) > 3 else f' (got {got!r})'
        return f'{place}: {item["msg"]}{said}'
    valid = _fields_at(model, item['loc'][:-1])
    close = difflib.get_close_matches(str(item['loc'][-1]), valid, n=1, cutoff=0.0)
    hint = f"; did you mean '{close[0]}'?" if close else ''
    return f"unknown key '{place}'{hint} Valid keys: {', '.join(sorted(valid))}"


def _fields_at(model: type[BaseModel], loc: tuple) -> list[str]:
    """Names of the fields of the (possibly nested) model that `loc` leads to."""
    current: Any = model
    for part in loc:
        if isinstance(part, int):
            continue  # an index into a list keeps the list's item model
        field = current.model_fields.get(part) if _is_model(current) else None
        current = _inner_model(field.annotation) if field else None
        if current is None:
            return []
    return list(current.model_fields)


def _is_model(candidate: Any) -> bool:
    return isinstance(candidate, type) and issubclass(candidate, BaseModel)


def _inner_model(annotation: Any) -> Any:
    if _is_model(annotation):
        return annotation
    for inner in getattr(annotation, '__args__', ()):
        found = _inner_model(inner)
        if found is not None:
            return found
    return None
