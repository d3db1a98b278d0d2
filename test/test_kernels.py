"""Compiled kernels take few arguments: what belongs together comes as one named group."""

import ast
from pathlib import Path

import continuum_loc
import pytest

PACKAGE = Path(continuum_loc.__file__).parent
MOST = 8
FILES = [PACKAGE / 'lie_kernels.py', *sorted((PACKAGE / 'estimator').rglob('*.py'))]


def kernels(source: str) -> dict[str, int]:
    """Count the arguments of each compiled function."""
    return {
        node.name: len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef)
        and any('njit' in ast.unparse(decorator) for decorator in node.decorator_list)
    }


def test_a_kernels_arguments_are_counted():
    source = '@njit(cache=True)\ndef f(a, b, *, c): ...\n@njit\ndef g(): ...\ndef h(a): ...'
    assert kernels(source) == {'f': 3, 'g': 0}


@pytest.mark.parametrize('file', FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_no_kernel_takes_more_than_eight_arguments(file):
    found = kernels(file.read_text())
    assert {name: count for name, count in found.items() if count > MOST} == {}
