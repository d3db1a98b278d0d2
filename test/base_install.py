"""
An environment as `pip install .[ros]` makes it, of links into the present one.

It holds what the base needs, what that needs, and a copy of the package: no extra, no checkout.
"""

from __future__ import annotations

import ast
from importlib import metadata
from pathlib import Path
import shutil
import sys
import sysconfig
import venv

import continuum_loc
from packaging.requirements import Requirement

ROOT = Path(continuum_loc.__file__).parents[1]
OWN = ('continuum_loc', 'msg_tools')
NEVER = {'__pycache__', '..', '.'}


def required(extras: tuple[str, ...] = ()) -> list[str]:
    """List the requirements of the base, and of some extras, as setup.py has them."""
    call = next(
        node
        for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == 'setup'
    )
    given = {keyword.arg: keyword.value for keyword in call.keywords}
    of_extras = ast.literal_eval(given['extras_require'])
    base = ast.literal_eval(given['install_requires'])
    return base + [one for extra in extras for one in of_extras[extra]]


def distributions(requirements: list[str]) -> dict[str, metadata.Distribution]:
    """Find what is installed of these requirements and of all that they require, by name."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [(Requirement(one), {''}) for one in requirements]
    while waiting:
        one, asked = waiting.pop()
        if one.marker and not any(one.marker.evaluate({'extra': extra}) for extra in asked):
            continue
        made = metadata.distribution(one.name)
        name = made.metadata['Name'].lower()
        if name in found and not one.extras:
            continue
        found[name] = made
        waiting += [(Requirement(each), {'', *one.extras}) for each in made.requires or ()]
    return found


def make(folder: Path, extras: tuple[str, ...] = ()) -> Path:
    """Make the environment in `folder`; its Python."""
    venv.create(folder, symlinks=True, with_pip=False)
    here = Path(sysconfig.get_path('purelib'))
    site = Path(sysconfig.get_path('purelib', vars={'base': str(folder)}))
    for made in distributions(required(extras)).values():
        for top in {file.parts[0] for file in made.files or ()} - NEVER:
            if not (site / top).exists():
                (site / top).symlink_to(here / top)
    for place in ('share', *(f'lib/{one.name}' for one in (Path(sys.prefix) / 'lib').iterdir())):
        if not (folder / place).exists() and (Path(sys.prefix) / place).exists():
            (folder / place).symlink_to(Path(sys.prefix) / place)
    for package in OWN:
        shutil.copytree(ROOT / package, site / package)
    return folder / 'bin' / 'python'
