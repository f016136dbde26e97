"""From the arguments of a call to the struct that its handler takes: the same rules for every transport.

A query string knows only strings, so each field takes what means its type as a string too. The messages are
Moonraker's (dialects/moonraker.md 1.2), which clients show as they are.
"""

import math
import types
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, NamedTuple, TypeAlias, TypeVar, Union, get_args, get_origin

import msgspec

from toolpost.dialects.moonraker.errors import RpcError

Params: TypeAlias = Mapping[str, Any]
Convert: TypeAlias = Callable[[str, Any], Any]
T = TypeVar("T", bound=msgspec.Struct)

_SHOWN: Final = 200
_NUMBER_DIGITS: Final = 40
_BOOLS: Final = {"true": True, "false": False}


class _Field(NamedTuple):
    attribute: str
    name: str
    convert: Convert
    required: bool


def compile_params(struct: type[T]) -> Callable[[Params], T]:
    """Return what makes a `struct` from the arguments of a call; arguments it does not know are ignored.

    Fields may be str, int, float, bool, lists of those, dict, Any, and each of them ``| None``; any other
    type is left to msgspec, and so are the bounds of an Annotated one. A field that may be msgspec's UNSET
    must not be null.

    Returns:
        a function that raises RpcError 400, whose message names the argument.
    """
    fields = [
        _Field(field.name, field.encode_name, _converter(field.type), field.required)
        for field in msgspec.structs.fields(struct)
    ]

    def convert(params: Params) -> T:
        values = {}
        for field in fields:
            if field.name in params:
                values[field.attribute] = field.convert(field.name, params[field.name])
            elif field.required:
                raise RpcError(400, f"No data for argument: {field.name}")
        return struct(**values)

    return convert


def convert_hinted(name: str, hint: str, value: str) -> Any:  # noqa: ANN401  # any JSON
    """Return an argument of a query string or a form whose name carries a type hint, as in ``count:int``.

    The hints are those of the documentation (external_api/introduction.md, "Query string type hints"),
    ``str``, and ``array_`` before any of them for a list with commas.

    Raises:
        RpcError: 400, the value is none of that type.
    """
    if hint.startswith("array_"):
        return [_HINTS[hint.removeprefix("array_")](name, part) for part in split(value)]
    return _HINTS[hint](name, value)


def is_hint(hint: str) -> bool:
    """Whether a name may end in ``:hint``."""
    return hint.removeprefix("array_") in _HINTS


def split(value: str) -> list[str]:
    """Return the parts of a list with commas, without blanks around them and without empty ones."""
    return [part for part in map(str.strip, value.split(",")) if part]


def _converter(kind: Any) -> Convert:  # noqa: ANN401  # a type annotation
    if get_origin(kind) is Annotated:
        return _bounded(_converter(get_args(kind)[0]), kind)
    if get_origin(kind) in {Union, types.UnionType}:
        return _union(get_args(kind))
    if kind in _SCALARS:
        return _SCALARS[kind]
    if get_origin(kind) is list and get_args(kind)[0] in _SCALARS:
        return _list_of(get_args(kind)[0])
    if kind is Any:
        return lambda _, value: value
    if kind is dict or get_origin(kind) is dict:
        return _dict
    return _other(kind)


def _union(kinds: tuple[Any, ...]) -> Convert:
    real = [kind for kind in kinds if kind not in {types.NoneType, msgspec.UnsetType}]
    convert = _converter(real[0]) if len(real) == 1 else _other(Union[tuple(real)])  # noqa: UP007  # made at run time
    if types.NoneType not in kinds:
        return convert
    return lambda name, value: None if value is None else convert(name, value)


def _bounded(convert: Convert, kind: Any) -> Convert:  # noqa: ANN401  # a type annotation
    check = _other(kind)
    return lambda name, value: check(name, convert(name, value))


def _other(kind: Any) -> Convert:  # noqa: ANN401  # a type annotation
    def convert(name: str, value: Any) -> Any:  # noqa: ANN401
        try:
            return msgspec.convert(value, kind, strict=False)
        except msgspec.ValidationError as error:
            raise RpcError(400, f"Invalid value received for argument '{name}'.  {error}") from None

    return convert


def _list_of(kind: type) -> Convert:
    part = _SCALARS[kind]

    def convert(name: str, value: Any) -> list[Any]:  # noqa: ANN401
        if isinstance(value, str):
            return [part(name, text) for text in split(value)]
        if not isinstance(value, list):
            found = type(value).__name__
            raise RpcError(
                400, f"Invalid value received for argument '{name}'.  Expected List type, received {found}"
            )
        if any(type(item) is not kind for item in value):
            raise RpcError(
                400,
                f"Invalid list format for argument '{name}', "
                f"expected all values to be of type {kind.__name__}.",
            )
        return value

    return convert


def _bool(name: str, value: Any) -> bool:  # noqa: ANN401
    """1.2: only ``true`` and ``false``, as JSON or as a string in any case."""
    if isinstance(value, bool):
        return value
    found = _BOOLS.get(value.lower()) if isinstance(value, str) else None
    if found is None:
        raise _cannot(name, bool, value)
    return found


def _str(name: str, value: Any) -> str:  # noqa: ANN401
    """1.2, JUMP: a number stands for its digits."""
    if isinstance(value, str):
        return value
    if isinstance(value, int | float) and not isinstance(value, bool):
        return str(value)
    raise _cannot(name, str, value)


def _int(name: str, value: Any) -> int:  # noqa: ANN401
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, str) and len(value) <= _NUMBER_DIGITS and "_" not in value:
        try:
            return int(value)
        except ValueError:
            pass
    raise _cannot(name, int, value)


def _float(name: str, value: Any) -> float:  # noqa: ANN401
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            number = float(value)
        except (ValueError, OverflowError):
            number = math.nan
        if math.isfinite(number) and not (isinstance(value, str) and "_" in value):
            return number
    raise _cannot(name, float, value)


def _dict(name: str, value: Any) -> dict[str, Any]:  # noqa: ANN401
    if isinstance(value, dict):
        return value
    raise _cannot(name, dict, value)


def _json(name: str, value: str) -> Any:  # noqa: ANN401  # any JSON
    try:
        return msgspec.json.decode(value)
    except (msgspec.DecodeError, RecursionError):
        raise RpcError(400, f"Unable to convert argument [{name}] to JSON") from None


def _cannot(name: str, kind: type, value: object) -> RpcError:
    shown = str(value)
    if len(shown) > _SHOWN:
        shown = f"{shown[:_SHOWN]}..."
    return RpcError(400, f"Unable to convert argument [{name}] to {kind}: value received: {shown}")


_SCALARS: Final[dict[Any, Convert]] = {str: _str, int: _int, float: _float, bool: _bool}
_HINTS: Final[dict[str, Convert]] = {
    "str": _str,
    "int": _int,
    "float": _float,
    "bool": _bool,
    "json": _json,
}
