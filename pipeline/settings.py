"""Settings of a run: defaults, then layers over them, checked against each stage's model."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from scanloom.pipeline.node import Node
from scanloom.schemas.errors import UsageError

Layer = tuple[str, Mapping[str, Mapping[str, Any]]]
"""Where settings come from (a file, the command line), and {stage: {field: value}}."""


def resolve(nodes: Sequence[Node], layers: Sequence[Layer]) -> dict[str, BaseModel]:
    """Settings of every stage by its name; a later layer wins over an earlier one.

    Raises
    ------
    UsageError : a stage or field is unknown (the nearest known one is named), or a value is out of bounds.
    """
    models = _models(nodes)
    shared = {node.name: node.settings_of for node in nodes if node.name not in models}
    merged: dict[str, dict[str, Any]] = {name: {} for name in models}
    for origin, layer in layers:
        for stage, values in layer.items():
            if stage in shared:
                raise UsageError(
                    f"{stage!r} has no settings of its own",
                    where=origin,
                    next_step=f"set those of `{shared[stage]}`, which it uses",
                )
            _known(stage, list(models), "stage", origin)
            if not isinstance(values, Mapping):
                raise UsageError(
                    f"settings of stage {stage} must be fields and values, not {values!r}",
                    where=origin,
                    next_step=f"write {stage}: {{field: value}}",
                )
            for field in values:
                _known(str(field), list(models[stage].model_fields), f"setting of stage {stage}", origin)
            merged[stage] = _merge(merged[stage], values)
    settings = {name: _validated(name, models[name], merged[name], layers) for name in models}
    return {node.name: _of(node, settings[node.settings_of]) for node in nodes}


def _models(nodes: Sequence[Node]) -> dict[str, type[BaseModel]]:
    """Models of the stages that have settings of their own; the others find all their fields there."""
    models = {node.name: node.settings for node in nodes if node.settings_of == node.name}
    for node in nodes:
        owner = models.get(node.settings_of)
        if owner is None:
            raise UsageError(f"node {node.name} uses the settings of {node.settings_of}, which has none")
        lacking = sorted(set(node.settings.model_fields) - set(owner.model_fields))
        if lacking:
            raise UsageError(
                f"node {node.name} needs {', '.join(lacking)}, which {node.settings_of} cannot be told"
            )
    return models


def _of(node: Node, settings: BaseModel) -> BaseModel:
    """What a stage sees of the settings it uses: the fields of its own model."""
    if type(settings) is node.settings:
        return settings
    return node.settings.model_validate(
        {name: getattr(settings, name) for name in node.settings.model_fields}
    )


def _known(name: str, known: Sequence[str], kind: str, origin: str) -> None:
    if name in known:
        return
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    advice = f"did you mean `{near[0]}`?" if near else f"known are {', '.join(known) or 'none'}"
    raise UsageError(f"{name!r} is no {kind}", where=origin, next_step=advice)


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` wins; nested mappings are merged field by field."""
    merged = dict(base)
    for name, value in over.items():
        below = merged.get(name)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            merged[name] = _merge(below, value)
        else:
            merged[name] = value
    return merged


def _validated(
    stage: str, model: type[BaseModel], values: Mapping[str, Any], layers: Sequence[Layer]
) -> BaseModel:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(piece) for piece in first["loc"])
        origin = _origin(stage, str(first["loc"][0]) if first["loc"] else "", layers)
        message = first["msg"].removeprefix("Value error, ")
        raise UsageError(
            f"settings.{stage}.{field} = {first['input']!r}: {message[:1].lower()}{message[1:]}",
            where=origin,
            next_step=_meaning(model, first["loc"]),
        ) from error


def _origin(stage: str, field: str, layers: Sequence[Layer]) -> str:
    """The last layer that sets the field."""
    setters = [origin for origin, layer in layers if field in layer.get(stage, {})]
    return setters[-1] if setters else "defaults"


def _meaning(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    field = model.model_fields.get(str(location[0])) if location else None
    if field is None or not field.description:
        return ""
    default = (
        "" if field.is_required() else f"; the default is {field.get_default(call_default_factory=True)!r}"
    )
    return f"it means: {field.description}{default}"
