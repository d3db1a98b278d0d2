"""
Typed settings read from YAML: one way to load them, one way to complain about them.

Every YAML file of the package (robot, plant, estimator, scene) is a `Settings` subclass. A key
that does not exist is refused with the nearest valid name; a value out of range is refused with
its place.
"""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any, TypeVar

from continuum_loc.errors import SettingsError
from pydantic import BaseModel, ConfigDict, Field, ValidationError
import yaml


class Settings(BaseModel):
    """Base of all typed settings: immutable; unknown keys and what is not finite are errors."""

    model_config = ConfigDict(
        extra='forbid', frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False
    )


S = TypeVar('S', bound=Settings)


def live(default: Any, **rest: Any) -> Any:
    """Describe a field that may change while the node runs."""
    return Field(default, json_schema_extra={'live': True}, **rest)


def load_settings(model: type[S], path: str | Path) -> S:
    """
    Read a YAML file into `model`.

    Raises SettingsError naming the file, the key and the valid values.
    """
    path = Path(path)
    try:
        data = yaml.safe_load(path.read_text())
    except OSError as error:
        raise SettingsError(f'{path}: cannot be read ({error.strerror})') from None
    except UnicodeDecodeError:
        raise SettingsError(f'{path}: not a text file; write YAML in UTF-8') from None
    except yaml.YAMLError as error:
        raise SettingsError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    return parse_settings(model, data if data is not None else {}, where=str(path))


def load_bundled(model: type[S], folder: Path, name_or_path: str | Path, what: str) -> S:
    """
    Load settings from the package's `folder/NAME.yaml`, or from a YAML file of one's own.

    what: what it is, for the error. Raises SettingsError listing the names that there are.
    """
    path = Path(name_or_path)
    if path.suffix in ('.yaml', '.yml'):
        return load_settings(model, path)
    bundled = folder / f'{name_or_path}.yaml'
    if not bundled.is_file():
        names = ', '.join(sorted(file.stem for file in folder.glob('*.yaml')))
        raise SettingsError(f"no {what} '{name_or_path}': give a .yaml file, or one of {names}")
    return load_settings(model, bundled)


def parse_settings(model: type[S], data: Any, where: str = 'settings') -> S:
    """Validate a mapping into `model`. `where` starts each line of the error."""
    if not isinstance(data, dict):
        raise SettingsError(f'{where}: expected a mapping of keys, got {type(data).__name__}')
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines = [f'{where}: {_explain(model, item)}' for item in error.errors()]
        raise SettingsError('\n'.join(lines)) from None


def dump_settings(settings: Settings, path: str | Path) -> None:
    """Write settings as YAML that `load_settings` reads back to an equal object."""
    Path(path).write_text(yaml.safe_dump(settings.model_dump(mode='json'), sort_keys=False))


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
