"""
What code decides a result: the modules that some entries import, and a digest of what they say.

The modules are found in the source, not in a process: every import counts, also those inside
functions, whether or not it is reached. Those under `if TYPE_CHECKING:` decide nothing and are
left out. With the modules go the YAML files of their rooms (a room is the folder of a package):
robots, presets, plants. A digest is of what the code says: comments, docstrings and layout do not
change it. Versions of the libraries that the modules import are part of it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
import hashlib
from importlib import metadata
from pathlib import Path
import sys

ROOT = Path(__file__).parents[1]
PACKAGES = ('continuum_loc', 'msg_tools', 'studies', 'bench')
DISTRIBUTIONS = {'yaml': 'PyYAML', 'PIL': 'pillow'}  # that are not called as their modules are
HOMES = '_HOMES'  # in a package that loads its modules lazily: {name: module that holds it}


class Closure:
    """
    The modules that `entries` import, directly and through others, under a folder `root`.

    modules: {name: file}, the entries and the packages around each among them. libraries: names
    of the top-level modules of other packages that they import. Raises ModuleNotFoundError for
    an entry that is not there.
    """

    def __init__(self, entries: Iterable[str], root: Path = ROOT) -> None:
        self.root = root
        self.modules: dict[str, Path] = {}
        self.libraries: set[str] = set()
        waiting = list(entries)
        for name in waiting:
            if self._file(name) is None:
                raise ModuleNotFoundError(f'no module {name} under {root}')
        while waiting:
            name = waiting.pop()
            if name in self.modules:
                continue
            self.modules[name] = self._file(name)
            waiting += [parent for parent in _parents(name) if parent not in self.modules]
            for imported in imports_of(self.modules[name], name):
                waiting += self._resolved(imported)

    def files(self, presets: bool = True) -> list[Path]:
        """List the files of the modules and, with `presets`, the YAML files of their rooms."""
        rooms = {path.parent for path in self.modules.values() if path.name == '__init__.py'}
        settings = [
            path
            for room in (rooms if presets else ())
            for path in room.rglob('*.yaml')
            if not any((between / '__init__.py').is_file() for between in _between(path, room))
        ]
        return sorted([*self.modules.values(), *settings])

    def digest(self, presets: bool = True) -> str:
        """Digest what the files say, presets to the byte, and the versions of the libraries."""
        digest = hashlib.sha256()
        for path in self.files(presets):
            digest.update(f'{path.relative_to(self.root)} {said_by(path)} '.encode())
        digest.update(repr(sorted(_versions(self.libraries))).encode())
        return digest.hexdigest()[:16]

    def _file(self, name: str) -> Path | None:
        path = self.root.joinpath(*name.split('.'))
        candidates = (path / '__init__.py', path.with_name(f'{path.name}.py'))
        return next((one for one in candidates if one.is_file()), None)

    def _resolved(self, imported: Imported) -> list[str]:
        """Return the modules of ours that an import reaches; note a library otherwise."""
        if not is_ours(imported.module):
            self.libraries.add(imported.module.partition('.')[0])
            return []
        below = f'{imported.module}.{imported.name}'
        if imported.name and self._file(below) is not None:
            return [below, *self._homes(below, '')]
        if self._file(imported.module) is None:
            return []
        return [imported.module, *self._homes(imported.module, imported.name)]

    def _homes(self, package: str, name: str) -> list[str]:
        """Modules that a lazy package loads for a name; all of them where none is given."""
        file = self._file(package)
        homes = _homes_in(file.read_bytes()) if file.name == '__init__.py' else {}
        wanted = homes.values() if name in ('', '*') else [homes[name]] if name in homes else []
        return [f'{package}.{module}' for module in wanted]


class Imported:
    """One name that is imported: `from module import name`, or `import module` without a name."""

    def __init__(self, module: str, name: str = '') -> None:
        self.module, self.name = module, name


@cache
def digest_of_code(*entries: str, presets: bool = True) -> str:
    """Digest all the code, and the presets, of this installation that decide what modules do."""
    return Closure(entries).digest(presets)


def is_ours(module: str) -> bool:
    """Whether a module is of this project, by its name."""
    return module.partition('.')[0] in PACKAGES


def imports_of(path: Path, name: str) -> tuple[Imported, ...]:
    """List the imports of a file, which is the module `name`, wherever in it they stand."""
    package = name if path.name == '__init__.py' else name.rpartition('.')[0]
    return _imports_in(path.read_bytes(), package)


def said_by(path: Path) -> str:
    """Digest what a Python file says, without words and layout, and other files to the byte."""
    content = path.read_bytes()
    return _said_in(content) if path.suffix == '.py' else hashlib.sha256(content).hexdigest()


@cache
def _imports_in(code: bytes, package: str) -> tuple[Imported, ...]:
    folders = package.split('.')
    found = []
    for node in _runs(ast.parse(code)):
        if isinstance(node, ast.Import):
            found += [Imported(alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = folders[: len(folders) + 1 - node.level] if node.level else []
            module = '.'.join([*above, *filter(None, [node.module])])
            found += [Imported(module, alias.name) for alias in node.names]
    return tuple(found)


@cache
def _said_in(code: bytes) -> str:
    tree = ast.parse(code)
    for node in ast.walk(tree):
        documented = isinstance(
            node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        )
        if documented and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


@cache
def _homes_in(code: bytes) -> dict[str, str]:
    for node in ast.parse(code).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == HOMES:
            return ast.literal_eval(node.value)
    return {}


def _runs(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a tree's nodes but for those that only a type checker sees."""
    yield node
    if isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test):
        children: Iterable[ast.AST] = node.orelse
    else:
        children = ast.iter_child_nodes(node)
    for child in children:
        yield from _runs(child)


def _parents(name: str) -> list[str]:
    parts = name.split('.')
    return ['.'.join(parts[:k]) for k in range(1, len(parts))]


def _between(path: Path, room: Path) -> list[Path]:
    """Folders below `room` on the way to a file."""
    return [folder for folder in path.parents if room in folder.parents]


def _versions(libraries: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the version of each library that is installed, by name of its module."""
    for library in set(libraries) - sys.stdlib_module_names:
        try:
            yield library, metadata.version(DISTRIBUTIONS.get(library, library))
        except metadata.PackageNotFoundError:  # or of another name; to look for it takes 0.2 s
            for distribution in _distributions().get(library, ()):
                yield library, metadata.version(distribution)


@cache
def _distributions() -> dict[str, list[str]]:
    return dict(metadata.packages_distributions())
