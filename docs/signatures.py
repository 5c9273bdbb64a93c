"""Signatures of Equinox modules and named tuples on this site: they are classes without the decorator
`@dataclass`, and Griffe does not know that their fields are arguments."""

import re
from typing import Any

import griffe


_ANY_PLACE = griffe.ParameterKind.positional_or_keyword
_BY_NAME = griffe.ParameterKind.keyword_only
_BASES = re.compile(r"equinox\.Module|typing\.NamedTuple|diffrax\.Abstract\w+")
_NO_FIELD = re.compile(r"\b(ClassVar$|AbstractVar\[|AbstractClassVar\[)")


class ModuleSignatures(griffe.Extension):
    """Give concrete classes without an `__init__` the one that is generated from their fields."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        # All are found before the first is written, so that none counts as inherited.
        for class_, fields in [(x, _all_fields(x)) for x in _classes(pkg) if _is_generated(x)]:
            itself = griffe.Parameter("self", kind=_ANY_PLACE)
            fields = sorted(fields, key=lambda field: field.kind is _BY_NAME)
            init = griffe.Function(
                "__init__",
                parameters=griffe.Parameters(itself, *fields),
                returns="None",
                parent=class_,
            )
            class_.set_member("__init__", init)


def _classes(within: griffe.Module | griffe.Class) -> list[griffe.Class]:
    found = []
    for member in within.members.values():
        if not member.is_alias and (member.is_module or member.is_class):
            found += [member] if member.is_class else []
            found += _classes(member)
    return found


def _is_generated(class_: griffe.Class) -> bool:
    family = [class_, *class_.mro()]
    bases = [getattr(base, "canonical_path", str(base)) for x in family for base in x.bases]
    is_module = any(map(_BASES.fullmatch, bases))
    own = any("__init__" in x.members for x in family)
    return is_module and not own and not class_.name.startswith("Abstract")


def _all_fields(class_: griffe.Class) -> list[griffe.Parameter]:
    fields = {}
    for parent in reversed([class_, *class_.mro()]):
        fields |= _fields(parent)
    return list(fields.values())


def _fields(class_: griffe.Class) -> dict[str, griffe.Parameter]:
    fields, kind = {}, _ANY_PLACE
    for name, member in class_.members.items():
        annotation = str(getattr(member, "annotation", None) or "")
        if not member.is_attribute or not annotation or "property" in member.labels:
            continue
        # `ClassVar[...]` is taken off the annotation.
        if "instance-attribute" not in member.labels or _NO_FIELD.search(annotation):
            continue
        if annotation.endswith("KW_ONLY"):
            kind = _BY_NAME
            continue
        options = _options(member.value)
        if options is None:
            fields[name] = griffe.Parameter(
                name, annotation=member.annotation, kind=kind, default=member.value
            )
        elif options.get("init") != "False":
            own = _BY_NAME if options.get("kw_only") == "True" else kind
            default = "..." if "default_factory" in options else options.get("default")
            fields[name] = griffe.Parameter(
                name, annotation=member.annotation, kind=own, default=default
            )
    return fields


def _options(value: Any) -> dict[str, Any] | None:
    """The arguments of `eqx.field(...)`, `None` if a field is not written like that."""
    if not isinstance(value, griffe.ExprCall):
        return None
    if value.canonical_path not in ("equinox.field", "dataclasses.field"):
        return None
    return {x.name: x.value for x in value.arguments if isinstance(x, griffe.ExprKeyword)}
