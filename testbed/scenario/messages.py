"""How it is said: each mistake with file, line and key path, what is wrong and what to do."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from testbed.errors import choice, near, short, shown, unknown
from testbed.estimators import custom, registry
from testbed.estimators.federated import LocalSection
from testbed.estimators.section import DEFAULT_ESTIMATOR
from testbed.scenario import keypath
from testbed.scenario.keypath import KeyPath
from testbed.schema import keys_of
from testbed.sensors import registry as sensor_registry

ERRORS_SHOWN = 20
MISSING = "is missing: add it"
TAG_KEYS = ("leg", "source", "kind")  # whose values tell sections of a union apart


class Written(NamedTuple):
    """A scenario as it was given: data, text, the file's name and folder, and which override set which key."""

    data: dict[str, Any]
    text: str
    place: str
    set_paths: Mapping[KeyPath, str]
    folder: Path


def report(error: ValidationError, root: type[BaseModel], written: Written) -> list[str]:
    """Every error, each a line: file, line, key path, what is wrong and what to do; ``root`` is the whole's."""
    _, text, place, set_paths, _ = written
    said: dict[KeyPath, list[str]] = {}
    misspelt: set[KeyPath] = set()
    for details in error.errors(include_url=False):
        path, models = _locate(details, root, written)
        said.setdefault(path, []).append(_say(details, path, models))
        if details["type"] == "extra_forbidden":
            misspelt.update((*path[:-1], key) for key in near(str(path[-1]), _keys(models)))
    lines = keypath.line_numbers(text)
    messages = []
    for path, texts in said.items():
        if path in misspelt and all(text.startswith(MISSING) for text in texts):
            continue  # it is there under the name that is complained about already
        above = [path[:length] for length in range(len(path), -1, -1)]
        below = [p for p in set_paths if path and p[: len(path)] == path]
        override = next((set_paths[p] for p in above + below if p in set_paths), None)
        line = next((lines[p] for p in above if p in lines), None)
        at = f" (--set {short(override)})" if override else f":{line}" if line else ""
        key = f" {keypath.written(path)}:" if path else ""
        messages.append((line or 0, f"{place}{at}:{key} {', or '.join(dict.fromkeys(texts))}"))
    messages.sort(key=lambda message: message[0])
    told = [message for _, message in messages[:ERRORS_SHOWN]]
    if len(messages) > ERRORS_SHOWN:
        told.append(f"{place}: and {len(messages) - ERRORS_SHOWN} more")
    return told


def _locate(details: ErrorDetails, root: type[BaseModel], written: Written) -> tuple[KeyPath, list[type[BaseModel]]]:
    """The key path of an error, and the sections whose keys may stand beside it.

    Pydantic's location also names the branch that it took in a union, which is no part of the file's path.
    """
    loc = details["loc"]
    if "discriminator" in details.get("ctx", {}):
        loc = (*loc, details["ctx"]["discriminator"].strip("'"))
    here: Any = written.data
    path: KeyPath = ()
    models: list[type[BaseModel]] = [root]
    named = False  # whether the step is a name that the user gave, of one of several such sections
    for step in loc[:-1]:
        if isinstance(here, dict) and len(models) > 1 and step in (here.get(key) for key in TAG_KEYS):
            models = [m for m in models if any(step in _tags(m, key) for key in TAG_KEYS)]
        elif _holds(here, step):
            here = here[step]
            path = (*path, step)
            if len(path) == 2 and path[0] == "sensors":
                models = [sensor_registry.find(here["kind"], written.folder).section]
            elif len(path) == 2 and path[0] == "estimator":
                kind = here.get("kind", DEFAULT_ESTIMATOR)
                models = [registry.find(kind).section]
                options = custom.options_of(kind, written.folder) if models == [custom.CustomSection] else None
                models += [options] if options else []
            elif isinstance(step, str) and named:
                named = False
            elif isinstance(step, str):
                fields = [m.model_fields[keys_of(m)[step]].annotation for m in models if step in keys_of(m)]
                models = [model for annotation in fields for model in _sections(annotation)]
                named = any(get_origin(annotation) is dict for annotation in fields)
    if loc and (_holds(here, loc[-1]) or details["type"] in ("missing", "union_tag_not_found", "scenario")):
        path = (*path, loc[-1])
    if details["type"] == "sensor_kind" and details["input"]["kind"] != path[-1]:
        path = (*path, "kind")
    return ((*path, "kind") if details["type"] == "estimator_kind" else path), models


def _holds(here: Any, step: str | int) -> bool:
    return step in here if isinstance(here, dict) else isinstance(here, list) and isinstance(step, int)


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """The sections inside a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for argument in get_args(annotation) for section in _sections(argument)]


def _tags(model: type[BaseModel], key: str) -> tuple[Any, ...]:
    return get_args(model.model_fields[key].annotation) if key in model.model_fields else ()


def _say(details: ErrorDetails, path: KeyPath, models: Sequence[type[BaseModel]]) -> str:
    """What is wrong and what to do, in the words of this house."""
    kind, given, context = details["type"], details["input"], details.get("ctx", {})
    match kind:
        case "extra_forbidden":
            return _elsewhere(path, models) or f"unknown key: {choice(str(path[-1]), _keys(models))}"
        case "missing":
            return "is missing: this item needs one more value" if isinstance(path[-1], int) else _missing(path, models)
        case "sensor_kind":
            return str(context["text"])
        case "union_tag_not_found":
            known = [tag for model in models for tag in _tags(model, str(path[-1]))]
            return f"is missing: add it, one of {', '.join(known)}"
        case "union_tag_invalid":
            return unknown(str(path[-1]), str(context["tag"]), re.findall(r"'([^']*)'", context["expected_tags"]))
        case "literal_error":
            known = re.findall(r"'([^']*)'", context["expected"])
            return f"can't be {shown(given)}: {choice(str(given), known)}"
        case "value_error":
            return str(context["error"])
        case "scenario" | "estimator_kind":
            return str(context["text"])
        case "model_type" | "dict_type" | "model_attributes_type":
            return f"must be a table, not {shown(given)}"
        case "date_type" | "date_parsing" | "date_from_datetime_parsing" | "date_from_datetime_inexact":
            return f"must be a date such as 2026-06-01, not {shown(given)}"
        case "list_type" | "tuple_type":
            return f"must be a list, not {shown(given)}"
        case "finite_number":
            return f"must be a finite number, not {shown(given)}"
        case "too_long":
            return f"has {context['actual_length']} items, but at most {context['max_length']} are allowed"
        case "float_type":
            return f"must be a number, not {shown(given)}"
        case "int_type" | "int_from_float":
            return f"must be a whole number, not {shown(given)}"
        case "string_too_short":
            return "must not be empty"
        case "string_type":
            return f'must be text in quotes, such as "text", not {shown(given)}'
        case "bool_type":
            return f"must be true or false, not {shown(given)}"
    return f"{details['msg'].replace('Input should be', 'must be')}, not {shown(given)}"


def _missing(path: KeyPath, models: Sequence[type[BaseModel]]) -> str:
    """That a key has to be added, and what it is."""
    key = str(path[-1])
    fields = [model.model_fields[keys_of(model)[key]] for model in models if key in keys_of(model)]
    what = next((field.description for field in fields if field.description), None)
    return f"{MISSING} ({what})" if what else MISSING


def _elsewhere(path: KeyPath, models: Sequence[type[BaseModel]]) -> str:
    """That a key of an estimator is one of other kinds, empty when it is of none."""
    if len(path) != 3 or path[0] != "estimator":
        return ""
    key = str(path[-1])
    owners = [kind for kind, one in registry.BUILT_IN.items() if key in one.section.model_fields]
    here = [kind for kind, one in registry.BUILT_IN.items() if one.section in models]
    if not owners or not here:
        return ""
    inside = "locals" in _keys(models) and key in LocalSection.model_fields
    todo = "give it to its locals" if inside else "leave it out"
    return f"is a key of kind {' or '.join(map(repr, owners))}, not of {here[0]!r}: {todo}"


def _keys(models: Sequence[type[BaseModel]]) -> list[str]:
    return list(dict.fromkeys(key for model in models for key in keys_of(model)))
