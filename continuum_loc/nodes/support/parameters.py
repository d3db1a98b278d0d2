"""
Typed settings as ROS parameters.

Declared with description, unit and range, read back, and guarded while running.

A nested group becomes a dotted name (`filter.tof.gate`); a tuple of numbers an array. The pydantic
model stays the only place where names, defaults and limits are written down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import difflib
import sys
from typing import Any, get_args, get_origin, Literal, TypeVar

from continuum_loc.errors import InputError, SettingsError
from continuum_loc.settings import parse_settings, Settings
from continuum_loc.yaml_files import check_parameter_file, is_octal, OCTAL
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

S = TypeVar('S', bound=Settings)

# Parameters that rclpy itself declares or understands.
_ROS_NAMES = ('use_sim_time', 'start_type_description_service')
_ROS_PREFIXES = ('qos_overrides.',)


def check_arguments(arguments: Sequence[str]) -> None:
    """
    Refuse parameters that ROS reads otherwise than they are meant.

    ROS takes 015 for 13, and of two equal keys in a file the last. Raises SettingsError naming the
    file and the line, or the argument.
    """
    for option, value in zip(arguments, arguments[1:], strict=False):
        if option == '--params-file':
            check_parameter_file(value)
        elif option in ('-p', '--param') and is_octal(value.partition(':=')[2]):
            raise SettingsError(f'{option} {value}: {OCTAL}')


def declare(node: Node, defaults: S, prefix: str = '', live: bool = False) -> S:
    """
    Declare every field of `defaults`, and return the settings with the user's overrides applied.

    Fields that may not change at run time are read-only, unless all are `live`. Raises
    SettingsError naming the parameter, its value and what is valid.
    """
    for name, field, value in leaves(defaults, prefix):
        _accept_whole_number(node, name, value)
        try:
            descriptor = _descriptor(name, field, value)
            descriptor.read_only = not (live or _is_live(field))
            node.declare_parameter(name, _ros_value(value), descriptor)
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise SettingsError(
                f"parameter '{name}' ({field.description}; {constraint(field)}): {error}"
            ) from None
    return read(node, type(defaults), prefix)


def read(node: Node, model: type[S], prefix: str = '', changed: dict[str, Any] | None = None) -> S:
    """Read the settings of the node's present parameters, with `changed` values in their place."""
    return parse_settings(
        model, _nested(node, model, prefix, changed or {}), where=f'{node.get_name()} parameters'
    )


def refuse_unknown(node: Node) -> None:
    """
    Raise SettingsError where a parameter is set that the node does not have.

    A file or the command line may set it.
    """
    # rclpy has no public list of what was declared and what was overridden.
    valid = list(node._parameters)
    for name in node._parameter_overrides:
        if name in valid or name in _ROS_NAMES or name.startswith(_ROS_PREFIXES):
            continue
        raise SettingsError(
            f"{node.get_name()}: unknown parameter '{name}'; did you mean "
            f"'{nearest(name, valid)}'? "
            f'Valid: {", ".join(sorted(valid))}'
        )


def nearest(name: str, valid: Sequence[str]) -> str:
    """Return the valid name that is most like one: the whole of it, or its last part."""

    def likeness(other: str) -> tuple[float, float]:
        parts = [one.rpartition('.')[2] for one in (name, other)]
        whole, last = (
            difflib.SequenceMatcher(None, *pair).ratio() for pair in ((name, other), parts)
        )
        return max(whole, last), whole

    return max(valid, key=likeness)


def guard(node: Node, apply: Callable[[dict[str, Any]], str | None]) -> None:
    """
    Ask `apply` about every change at run time; what stays as it is is none.

    It returns the reason why not, or None when it took the values.
    """

    def on_set(parameters: list[Parameter]) -> SetParametersResult:
        values = {
            p.name: _plain(p.value)
            for p in parameters
            if p.name not in _ROS_NAMES
            and not p.name.startswith(_ROS_PREFIXES)
            and not is_set_to(node, p)
        }
        try:
            reason = apply(values) if values else None
        except InputError as error:
            reason = str(error)
        return SetParametersResult(successful=reason is None, reason=reason or '')

    node.add_on_set_parameters_callback(on_set)


def is_set_to(node: Node, parameter: Parameter) -> bool:
    """Whether the node's parameter of this name has this value already."""
    present = node._parameters.get(parameter.name)
    return present is not None and _plain(present.value) == _plain(parameter.value)


def leaves(settings: Settings, prefix: str) -> Iterator[tuple[str, FieldInfo, Any]]:
    """(full name, field, value) of every field, nested groups included."""
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if isinstance(value, Settings):
            yield from leaves(value, f'{prefix}{name}.')
        else:
            yield prefix + name, field, value


def _is_live(field: FieldInfo) -> bool:
    return bool((field.json_schema_extra or {}).get('live'))


def _accept_whole_number(node: Node, name: str, default: Any) -> None:
    """`rate: 10` means 10.0 where a float is declared; rclpy would refuse it."""
    given = node._parameter_overrides.get(name)
    if isinstance(default, float) and given is not None and given.type_ == Parameter.Type.INTEGER:
        node._parameter_overrides[name] = Parameter(
            name, Parameter.Type.DOUBLE, float(given.value)
        )


def _nested(
    node: Node, model: type[Settings], prefix: str, changed: dict[str, Any]
) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            data[name] = _nested(node, field.annotation, f'{prefix}{name}.', changed)
        else:
            full = prefix + name
            data[name] = (
                changed[full] if full in changed else _plain(node.get_parameter(full).value)
            )
    return data


def _ros_value(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _plain(value: Any) -> Any:
    """Return a parameter's value without array.array."""
    return value if isinstance(value, (str, bool, int, float, type(None))) else list(value)


def _descriptor(name: str, field: FieldInfo, value: Any) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        name=name, description=field.description or '', additional_constraints=constraint(field)
    )
    low, high = _limits(field)
    if isinstance(value, float) and (low, high) != (None, None):
        big = sys.float_info.max
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=float(-big if low is None else low),
                to_value=float(big if high is None else high),
                step=0.0,
            )
        ]
    elif isinstance(value, int) and not isinstance(value, bool) and (low, high) != (None, None):
        lowest, highest = -(2**63), 2**63 - 1
        descriptor.integer_range = [
            IntegerRange(
                from_value=int(lowest if low is None else low),
                to_value=int(highest if high is None else high),
                step=1,
            )
        ]
    return descriptor


def _limits(field: FieldInfo) -> tuple[float | None, float | None]:
    """Give closed bounds; an open one (`gt`) is refused by the model itself when it is set."""
    low = high = None
    for item in field.metadata:
        low = next(
            (getattr(item, key) for key in ('ge', 'gt') if getattr(item, key, None) is not None),
            low,
        )
        high = next(
            (getattr(item, key) for key in ('le', 'lt') if getattr(item, key, None) is not None),
            high,
        )
    return low, high


def constraint(field: FieldInfo) -> str:
    """Put the limits of a field in words; empty where it has none."""
    if get_origin(field.annotation) is Literal:
        return 'one of: ' + ', '.join(map(str, get_args(field.annotation)))
    signs = (('ge', '>='), ('gt', '>'), ('le', '<='), ('lt', '<'))
    found = [
        f'{sign} {getattr(item, key):g}'
        for item in field.metadata
        for key, sign in signs
        if getattr(item, key, None) is not None
    ]
    return ' and '.join(found)
