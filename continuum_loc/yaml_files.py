"""
YAML as a person means it: the core schema of YAML 1.2, each key once, and limits.

YAML 1.1, which libraries still read by default, takes `015` for 13, `12:30:00` for 45000, `no` for
false, and the last of two equal keys. Here `015` is 15, `12:30:00` and `no` are texts, and a key
that is given twice is an error that names both lines. A file that is too large, too deep, or that
unfolds to too much is refused before it is read any further.
"""

from __future__ import annotations

from pathlib import Path
import re
from typing import Any

from continuum_loc.errors import SettingsError
import yaml

LARGEST_FILE = 4_000_000  # bytes; a trajectory of 10,000 key frames has one
DEEPEST = 50  # collections inside of each other; our own files have six
MOST_VALUES = 100_000  # also after every anchor was put where it is named
LONGEST_NUMBER = 40  # characters; a double has 17 digits

_TAG = 'tag:yaml.org,2002:'
_PLAIN_TAGS = {
    _TAG + name for name in ('null', 'bool', 'int', 'float', 'str', 'seq', 'map', 'merge')
}
# YAML 1.2.2, 10.3.2 (core schema), and the merge key, which 1.2 knows as an extension.
_CORE = (
    ('null', r'~|null|Null|NULL|', ['~', 'n', 'N', '']),
    ('bool', r'true|True|TRUE|false|False|FALSE', list('tTfF')),
    ('int', r'[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+', list('-+0123456789')),
    (
        'float',
        r'[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?'
        r'|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)',
        list('-+.0123456789'),
    ),
    ('merge', r'<<', ['<']),
)
OCTAL = 'ROS reads a number that begins with 0 as octal; leave the leading 0 out'


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):
    """PyYAML's safe loader with the core schema of YAML 1.2."""

    yaml_implicit_resolvers: dict = {}


class _Dumper(yaml.SafeDumper):
    """Quotes what either version of YAML would take for something else than a text."""

    yaml_implicit_resolvers = {
        first: list(rules) for first, rules in yaml.SafeDumper.yaml_implicit_resolvers.items()
    }


for _name, _pattern, _first in _CORE:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(_TAG + _name, re.compile(f'(?:{_pattern})$'), _first)


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = node.value
    base = {'0x': 16, '0o': 8}.get(text[:2], 10)
    try:
        if len(text) > LONGEST_NUMBER:
            raise ValueError
        return int(text, base)
    except ValueError:
        raise _problem(node, f"'{text[:50]}' is no whole number that can be used") from None


def _real(loader: _Loader, node: yaml.ScalarNode) -> float:
    text = node.value.lower()
    try:
        return float(text.replace('.inf', 'inf').replace('.nan', 'nan'))
    except ValueError:
        raise _problem(node, f"'{text[:50]}' is no number") from None


_Loader.add_constructor(_TAG + 'int', _integer)
_Loader.add_constructor(_TAG + 'float', _real)


class Document:
    """A YAML file as it was read: `data`, and on which line of the file each value stands."""

    def __init__(self, data: Any, root: yaml.Node | None) -> None:
        self.data = data
        self._root = root

    def line_of(self, place: tuple) -> int | None:
        """
        Line (from 1) of the value that keys and indices lead to, or of the last one on the way.

        None where the file is empty.
        """
        node = self._root
        for step in place:
            found = _child(node, step)
            if found is None:
                break
            node = found
        return None if node is None else node.start_mark.line + 1


def read_yaml(path: str | Path) -> Document:
    """
    Read a YAML file of one document.

    Raises SettingsError naming the file, the line and what is wrong with it.
    """
    path = Path(path)
    text = read_text(path)
    try:
        root = _composed(text)
        return Document(None if root is None else _constructed(root), root)
    except yaml.YAMLError as error:
        raise _refusal(path, error) from None


def write_yaml(data: Any, path: str | Path) -> None:
    """Write plain data so that this reader, and one of YAML 1.1, read it back as it is."""
    Path(path).write_text(yaml.dump(data, Dumper=_Dumper, sort_keys=False), encoding='utf-8')


def read_text(path: Path) -> str:
    """
    Read a small text file in UTF-8, or in UTF-16 with a byte-order mark.

    Raises SettingsError where it is none, or larger than LARGEST_FILE.
    """
    try:
        if path.is_dir():
            raise SettingsError(f'{path}: a folder, not a file')
        with path.open('rb') as stream:
            data = stream.read(LARGEST_FILE + 1)
    except OSError as error:
        raise SettingsError(f'{path}: cannot be read ({error.strerror})') from None
    if len(data) > LARGEST_FILE:
        raise SettingsError(
            f'{path}: larger than {LARGEST_FILE / 1e6:g} MB, which no settings are'
        )
    try:
        return data.decode('utf-16' if data[:2] in (b'\xff\xfe', b'\xfe\xff') else 'utf-8-sig')
    except UnicodeDecodeError:
        raise SettingsError(f'{path}: not a text file; write YAML in UTF-8') from None


def check_parameter_file(path: str | Path) -> None:
    """
    Refuse a file of ROS parameters that ROS itself would read otherwise than it is meant.

    ROS takes `015` for 13 and the last of two equal keys. Raises SettingsError with the line.
    """
    path = Path(path)
    try:
        root = _composed(read_text(path))
        for node in _scalars(root):
            if not node.style and is_octal(node.value):
                raise _problem(node, f'{node.value}: {OCTAL}')
    except yaml.YAMLError as error:
        raise _refusal(path, error) from None


def check_yaml(path: Path) -> None:
    """
    Refuse a YAML file that is none, is nested too deep or unfolds to too much.

    For files that others read, who may not look. Raises SettingsError.
    """
    try:
        _composed(read_text(path))
    except yaml.YAMLError as error:
        raise _refusal(path, error) from None


def is_octal(text: str) -> bool:
    """Tell whether ROS takes a plain text for an octal number."""
    return re.fullmatch(r'[-+]?0[0-7]+', text) is not None


def _composed(text: str) -> yaml.Node | None:
    """Compose the tree of nodes, after a look at its depth, and check keys, tags and size."""
    depth, values = 0, 0
    for event in yaml.parse(text, Loader=_Loader):
        values += 1
        if values > 2 * MOST_VALUES:
            raise _problem(event, f'more than {MOST_VALUES} values')
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEEPEST:
                raise _problem(event, f'nested deeper than {DEEPEST} levels')
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    root = yaml.compose(text, Loader=_Loader)
    if root is not None:
        _check_tree(root, {})
    return root


def _check_tree(node: yaml.Node, sizes: dict[int, int | None]) -> int:
    """Count the values under a node, anchors unfolded. Raises where the tree cannot be used."""
    if id(node) in sizes:
        size = sizes[id(node)]
        if size is None:
            raise _problem(node, 'an anchor that holds itself')
        return size
    if node.tag not in _PLAIN_TAGS:
        raise _problem(node, f"tag '{node.tag.replace(_TAG, '!!')}' is not allowed")
    sizes[id(node)] = None
    if isinstance(node, yaml.MappingNode):
        _check_keys(node)
    size = 1 + sum(_check_tree(child, sizes) for child in _children(node))
    if size > MOST_VALUES:
        raise _problem(node, f'more than {MOST_VALUES} values, once its anchors are unfolded')
    sizes[id(node)] = size
    return size


def _check_keys(node: yaml.MappingNode) -> None:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _problem(key, 'a key must be one word')
        if (first := lines.get(key.value)) is not None:
            raise _problem(key, f"key '{key.value}' is given twice, first in line {first}")
        lines[key.value] = key.start_mark.line + 1


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [each for pair in node.value for each in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


def _scalars(node: yaml.Node | None) -> list[yaml.ScalarNode]:
    if node is None:
        return []
    if isinstance(node, yaml.ScalarNode):
        return [node]
    return [scalar for child in _children(node) for scalar in _scalars(child)]


def _child(node: yaml.Node | None, step: Any) -> yaml.Node | None:
    if isinstance(node, yaml.MappingNode):
        return next((value for key, value in node.value if key.value == str(step)), None)
    if isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
        return node.value[step]
    return None


def _constructed(root: yaml.Node) -> Any:
    loader = _Loader('')
    try:
        return loader.construct_document(root)
    finally:
        loader.dispose()


class _Problem(yaml.YAMLError):
    """What is valid YAML, and not for us."""


def _problem(where: Any, text: str) -> _Problem:
    return _Problem(f'line {where.start_mark.line + 1}: {text}')


def _refusal(path: Path, error: yaml.YAMLError) -> SettingsError:
    if isinstance(error, _Problem):
        return SettingsError(f'{path}, {error}')
    return SettingsError(f'{path}: not valid YAML: {" ".join(str(error).split())}')
