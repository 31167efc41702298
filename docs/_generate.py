"""What the manual takes from the code while it is built, and mathematics without scripts.

A line ``<!-- generated: NAME -->`` in a page becomes the Markdown that the function of that name in `PARTS` returns,
``<!-- example: FILE -->`` that file of ``docs/examples``.
Equations between dollars become MathML, which browsers show by themselves, so no page asks another host for anything.
"""

from __future__ import annotations

import html
import inspect
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
EXAMPLE = re.compile(r"^<!-- example: (\w+\.py) -->$", re.MULTILINE)
PLACEHOLDER = re.compile(r"^<!-- generated: ([a-z_]+) -->$", re.MULTILINE)

# --- the scenario reference, from pydantic's JSON schema

UNITS = {  # by the end of a key, longer ones first
    "_mps_per_sqrt_s": "m/s/√s",
    "_mps_per_km": "m/s/km",
    "_degphpg2": "deg/h/g²",
    "_degphprth": "deg/h/√h",
    "_mpsprth": "m/s/√h",
    "_degprth": "deg/√h",
    "_degphpg": "deg/h/g",
    "_degphpk": "deg/h/K",
    "_ut_per_a": "µT/A",
    "_mgprth": "mg/√h",
    "_mgpg2": "mg/g²",
    "_percent": "%",
    "_arcsec": "arcsec",
    "_degps": "deg/s",
    "_degph": "deg/h",
    "_mps2": "m/s²",
    "_mrad": "mrad",
    "_mgpk": "mg/K",
    "_mps": "m/s",
    "_deg": "deg",
    "_ppm": "ppm",
    "_hz": "Hz",
    "_ut": "µT",
    "_pa": "Pa",
    "_kg": "kg",
    "_mg": "mg",
    "_m": "m",
    "_s": "s",
    "_k": "K",
    "_g": "g",
}
PRESET = "keys that a grade presets, by model"
UNIT_OF = {"denied": "s", "window": "s"}  # keys that are windows of time


@dataclass(frozen=True, slots=True)
class Row:
    """One key of a section."""

    key: str
    type: str
    unit: str
    range: str
    default: str
    description: str


@dataclass(frozen=True, slots=True)
class Table:
    """One section of the scenario file: its model's name, where it stands, what it is, and its keys."""

    model: str
    heading: str
    level: int
    about: str
    rows: tuple[Row, ...]


def scenario_tables() -> list[Table]:
    """Every section that a scenario may have, in the order of the file."""
    from pydantic.json_schema import models_json_schema

    from testbed.estimators import registry
    from testbed.scenario import Scenario
    from testbed.sensors.timing import AidingTiming

    sensors = {**sensor_sections(), "module:Class": AidingTiming}
    estimators = {name: kind.section for name, kind in registry.BUILT_IN.items()}
    estimators["module:Class"] = registry.CUSTOM.section
    models = [(model, "validation") for model in (Scenario, *sensors.values(), *estimators.values())]
    references, schema = models_json_schema(models)  # type: ignore[arg-type]
    definitions = schema["$defs"]
    # Tables that are told apart by a key which the schema doesn't know of.
    registries: dict[Any, Any] = {
        ("Scenario", "sensors"): ("[{}.<name>]", {k: references[c, "validation"] for k, c in sensors.items()}),
        ("Scenario", "estimator"): ("[[{}]]", {k: references[c, "validation"] for k, c in estimators.items()}),
        PRESET: {config.__name__: frozenset(_preset(config)) for config in sensor_sections().values()},
    }
    return list(_tables(references[Scenario, "validation"], "", "The run", 2, definitions, registries))


def _tables(
    reference: Mapping[str, Any], path: str, heading: str, level: int, definitions: Any, registries: Any
) -> Iterator[Table]:
    """The table of one model, then those of the models inside it."""
    definition = _resolved(reference, definitions)
    required = definition.get("required", ())
    preset = registries[PRESET].get(definition["title"], frozenset())
    rows = tuple(
        _row(key, about, "**required**" if key in required else "by grade" if key in preset else "", definitions)
        for key, about in definition["properties"].items()
        if "const" not in about  # the heading says it
    )
    yield Table(definition["title"], heading, level, _plain(definition.get("description", "")), rows)
    for key, about in definition["properties"].items():
        dotted = f"{path}.{key}".lstrip(".")
        if (definition["title"], key) in registries:
            tag = "kind"
            brackets, inside = registries[definition["title"], key]
        else:
            tag, inside, many, named = _models(about)
            brackets = "[[{}]]" if many else "[{}.<name>]" if named else "[{}]"
        for name, child in inside.items():
            written = brackets.format(dotted)
            title = f"`{written}`" + (f', `{tag} = "{name}"`' if tag else "")
            below = dotted + ".<name>" * ("<name>" in brackets)
            yield from _tables(child, below, title, min(level + (level < 3 or bool(path)), 4), definitions, registries)


def _models(about: Mapping[str, Any]) -> tuple[str | None, dict[str, Any], bool, bool]:
    """Key that tells the sections inside a property apart, these by its value; whether many, whether named."""
    if "$ref" in about:
        return None, {"": about}, False, False
    if about.get("type") == "array" and "items" in about:
        tag, inside, _, named = _models(about["items"])
        return tag, inside, True, named
    if isinstance(about.get("additionalProperties"), Mapping):
        tag, inside, many, _ = _models(about["additionalProperties"])
        return tag, inside, many, True
    if "discriminator" in about:
        chosen = about["discriminator"]
        return chosen["propertyName"], {k: {"$ref": v} for k, v in chosen["mapping"].items()}, False, False
    for branch in (*about.get("anyOf", ()), *about.get("oneOf", ()), *about.get("allOf", ())):
        found = _models(branch)
        if found[1]:
            return found
    return None, {}, False, False


def _resolved(about: Mapping[str, Any], definitions: Any) -> Any:
    return definitions[about["$ref"].rpartition("/")[2]] if "$ref" in about else about


def _row(key: str, about: Mapping[str, Any], default: str, definitions: Any) -> Row:
    branches = [branch for branch in about.get("anyOf", (about,)) if branch.get("type") != "null"]
    description = about.get("description") or next((b["description"] for b in branches if "description" in b), "")
    unit = UNIT_OF.get(key) or next((unit for end, unit in UNITS.items() if key.endswith(end)), "")
    ranges = dict.fromkeys(filter(None, (_range(branch) for branch in branches)))
    types = dict.fromkeys(_type(branch, definitions) for branch in branches)
    return Row(key, " or ".join(types), unit, ", ".join(ranges), default or _default(about), _plain(description))


def _type(about: Mapping[str, Any], definitions: Any) -> str:
    if "const" in about:
        return f'`"{about["const"]}"`'
    if "enum" in about:
        return ", ".join(f'`"{choice}"`' for choice in about["enum"])
    if _models(about)[1] or about.get("items") == {}:
        return "tables" if about.get("type") == "array" or "additionalProperties" in about else "table"
    match about.get("type"):
        case "array" if "prefixItems" in about:
            return "[" + ", ".join(_type(item, definitions) for item in about["prefixItems"]) + "]"
        case "array":
            return f"list of {_type(about.get('items', {}), definitions)}"
        case "string":
            return "date" if about.get("format") == "date" else "text"
        case "boolean":
            return "true or false"
        case "integer":
            return "whole number"
        case "number":
            return "number"
    return "tables"


def _range(about: Mapping[str, Any]) -> str:
    if "items" in about or "prefixItems" in about:
        inner = about["items"] if "items" in about else about["prefixItems"][0]
        size = [
            f"{about[key]} {word}" for key, word in (("minItems", "or more"), ("maxItems", "at most")) if key in about
        ]
        of = "prefixItems" not in about and size
        return " ".join(filter(None, (", ".join(size) if of else "", _range(inner))))
    low, above = about.get("minimum"), about.get("exclusiveMinimum")
    high, below = about.get("maximum"), about.get("exclusiveMaximum")
    high, below = (None if isinstance(x, int) and x > 1e18 else x for x in (high, below))  # what 64 bits hold
    limits = [f"≥ {low:g}" if low is not None else "", f"> {above:g}" if above is not None else ""]
    limits += [f"≤ {high:g}" if high is not None else "", f"< {below:g}" if below is not None else ""]
    return ", ".join(filter(None, limits))


def _default(about: Mapping[str, Any]) -> str:
    default = about.get("default")
    if default is None or default in ([], {}):
        return "none"
    if isinstance(default, Mapping):
        return "its own"
    return f"`{default}`" if re.fullmatch(r"\d{4}-\d\d-\d\d", str(default)) else f"`{_toml(default)}`"


def _toml(value: Any) -> str:
    """A value as the file has it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float | int):
        return f"{value:.6g}"
    return f'"{value}"' if isinstance(value, str) else "[" + ", ".join(map(_toml, value)) + "]"


def _plain(text: str) -> str:
    """A docstring as one paragraph per paragraph, its double backquotes as Markdown has them."""
    return re.sub(r"[ \n]+", " ", text.replace("\n\n", "\0")).replace("\0", "\n\n").replace("``", "`").strip()


def scenario_reference() -> str:
    """All keys of a scenario, section by section."""
    parts, tables = [], scenario_tables()
    of_the_run = {row.key: row.description for row in tables[0].rows}
    chapter = ""
    for table in tables:
        now = re.match(r"`\[+(\w+)", table.heading)
        if now and now[1] != chapter:
            chapter = now[1]
            parts.append(f"## `{chapter}`\n\n{of_the_run[chapter][:1].upper()}{of_the_run[chapter][1:]}.")
        rows = [(f"`{row.key}`", row.type, row.unit, row.range, row.default, row.description) for row in table.rows]
        head = ("key", "type", "unit", "range", "default", "what it is")
        about = table.about if now else "The keys at the top of the file, and its sections."
        parts.append(f"{'#' * table.level} {table.heading}\n\n{about}\n\n{_table(head, rows) if rows else ''}")
        if any(row.key == "grade" for row in table.rows):
            kind = re.findall(r'"(.+)"', table.heading)[0]
            parts.append(f"What the grades preset: [Sensors](sensors.md#{kind.replace('_', '-')}).")
    return "\n\n".join(parts)


# --- sensors


def sensor_sections() -> dict[str, Any]:
    """The section of each kind of sensor."""
    from testbed.sensors import registry

    return {name: kind.section for name, kind in registry.BUILT_IN.items()}


def grade_tables() -> dict[str, str]:
    """By kind of sensor: what each grade presets, and where the figures come from."""
    return {kind: _grades(config) for kind, config in sensor_sections().items()}


def _grades(config: Any) -> str:
    rows = []
    for key, values in _preset(config).items():
        unit = next((unit for end, unit in UNITS.items() if key.endswith(end)), "")
        rows.append((f"`{key}`", unit, *map(_figure, values)))
    sources = [f"* `{name}`: {text}" for name, text in _sources(inspect.getmodule(config)).items()]
    head = ("key", "unit", *(f"`{name}`" for name in _grade_names(config)))
    return _table(head, rows) + "\n\nSources:\n\n" + "\n".join(sources)


def _grade_names(config: Any) -> list[str]:
    names: list[str] = config.model_json_schema()["properties"]["grade"]["enum"]
    return names


def _preset(config: Any) -> dict[str, list[Any]]:
    """The keys in which the grades differ, with the value of each."""
    graded = [config.model_validate({"grade": name}).model_dump() for name in _grade_names(config)]
    columns = {key: [one[key] for one in graded] for key in config.model_fields if key not in ("kind", "grade")}
    return {key: values for key, values in columns.items() if any(value != values[0] for value in values)}


def _figure(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return f"{value:.4g}"
    return ", ".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)


def _sources(module: Any) -> dict[str, str]:
    """By grade, the comment above it in the code, which says where its figures come from.

    The grades of ``imu`` are beside it in ``imu_grades``.
    """
    beside = f"{module.__name__}_grades"
    text = inspect.getsource(import_module(beside) if find_spec(beside) else module)
    text = text[text.index("GRADES: dict") :]
    found = re.findall(r'((?:^    # .*\n)+)^    "([a-z0-9-]+)": \{', text[: text.index("\n}\n")], re.MULTILINE)
    return {name: " ".join(line.strip().removeprefix("# ") for line in said.splitlines()) for said, name in found}


def fault_channels() -> str:
    """What faults can act on, by kind of sensor."""
    from testbed.sensors.faults import CHANNELS

    rows = []
    for kind, channels in CHANNELS.items():
        units: dict[tuple[str, ...], list[str]] = {}
        for name, channel in channels.items():
            units.setdefault(tuple(channel.units), []).append(f"`{name}`")
        rows.append((f"`{kind}`", "; ".join(f"{', '.join(names)} ({', '.join(of)})" for of, names in units.items())))
    return _table(("sensor", "channels, with the units that fit them"), rows)


def fault_kinds() -> str:
    """The kinds of faults, with their own keys."""
    rows = []
    for table in scenario_tables():
        if table.heading.startswith("`[[fault]]`"):
            kind = re.findall(r'"(.+)"', table.heading)[0]
            shared = {"name", "sensor", "window", "channel", "bearing_deg", "unit"}
            keys = [
                row.key
                for row in table.rows
                if row.key not in shared or (row.key == "bearing_deg" and "required" in row.default)
            ]
            rows.append((f"`{kind}`", ", ".join(f"`{key}`" for key in keys), table.about))
    return _table(("kind", "its own keys", "what it does"), rows)


# --- the rest


def shipped_scenarios() -> str:
    """The shipped scenarios with their titles."""
    rows = []
    for path in sorted((ROOT / "scenarios").glob("*.toml")):
        head = tomllib.loads(path.read_text("utf-8"))
        rows.append((f"`{path.stem}`", head["title"], f"{head['duration_s']:g} s"))
    return _table(("name", "title", "flown"), rows)


def metric_names() -> str:
    """All metrics: which way is better, and how far a golden value may be off."""
    from testbed import measures

    wanted = {"less": "small", "more": "large", "nearer to one": "1", "nearer to zero": "0", "none": "–"}
    groups = [
        ("of an estimator, `<estimator>.…`", measures.MEASURES),
        ("of an estimator and a sensor, `<estimator>.….<sensor>`", measures.OF_AIDS),
        ("of an estimator and a fault, `<estimator>.….<fault>`", measures.OF_FAULTS),
        ("of the aircraft, `flight.…`", measures.OF_FLIGHT),
        ("of the machine, `run.…`", measures.OF_RUN),
    ]
    parts = []
    for title, found in groups:
        rows: dict[tuple[str, str], list[str]] = {}
        for name, measure in found.items():
            tolerance = " or ".join(
                filter(
                    None,
                    (f"{measure.share:.0%}" if measure.share else "", f"{measure.floor:g}" if measure.floor else ""),
                )
            )
            if name.startswith(("outage_", "recovery_")) and name.partition("_")[2] in found:
                continue
            rows.setdefault((wanted[measure.aim.value], tolerance or "0"), []).append(f"`{name}`")
        parts.append(
            f"**{title}**\n\n"
            + _table(("metrics", "better", "tolerance"), [(", ".join(names), *of) for of, names in rows.items()])
        )
    return "\n\n".join(parts)


def commands() -> str:
    """The command line, from its own help."""
    import typer

    from testbed.__main__ import app

    group: Any = typer.main.get_command(app)
    parts = []
    for name, command in group.commands.items():
        context = command.make_context(name, [], resilient_parsing=True)
        usage = " ".join(command.collect_usage_pieces(context))
        rows = []
        for parameter in command.params:
            option = parameter.param_type_name == "option"
            called = (
                ", ".join((*parameter.opts, *parameter.secondary_opts))
                if option
                else (parameter.metavar or parameter.name.upper())
            )
            shown = f"`{called}`" + (f" `{parameter.metavar}`" if option and parameter.metavar else "")
            rows.append((shown, parameter.help or ""))
        about = inspect.cleandoc(command.help or "")
        parts.append(
            f"## testbed {name}\n\n```text\ntestbed {name} {usage}\n```\n\n{about}\n\n"
            + (_table(("argument or option", "what it does"), rows) if rows else "")
        )
    return "\n\n".join(parts)


def conventions() -> str:
    """Frames, names, units, signs and time, from the docstring of `nav`."""
    import nav

    found = re.findall(r"^(\w[\w ]*)\n((?:    .+\n)+)", inspect.cleandoc(nav.__doc__ or "") + "\n", re.MULTILINE)
    return "\n\n".join(f"{word}\n:   {_plain(text)}" for word, text in found)


def aircraft_modes() -> str:
    """Modes of the main aircraft without its autopilot."""
    from testbed.motion.modes import modes_table

    return modes_table()


def envelopes() -> str:
    """What is known of each shipped aircraft."""
    found = {
        path.parent.name: tomllib.loads(path.read_text("utf-8"))
        for path in sorted(ROOT.glob("aircraft/*/envelope.toml"))
    }
    keys = dict.fromkeys(
        (section, key) for one in found.values() for section, of in one.items() if section != "title" for key in of
    )
    rows = [
        (f"`{section}.{key}`", *(_figure(one.get(section, {}).get(key)) for one in found.values()))
        for section, key in keys
    ]
    titles = [f"* `{name}`: {one['title']}" for name, one in found.items()]
    return "\n".join(titles) + "\n\n" + _table(("key", *(f"`{name}`" for name in found)), rows)


RECORDED = """
title = "All that is recorded"
duration_s = 4
[truth]
source = "flight"
start = { lat_deg = 34.0, lon_deg = 108.0, alt_m = 800, heading_deg = 30, airspeed_mps = 25 }
[[plan]]
leg = "straight"
length_m = 5000
[sensors.imu]
[sensors.gnss]
[sensors.barometer]
[sensors.magnetometer]
[sensors.airspeed]
[sensors.body_velocity]
[sensors.star_tracker]
[sensors.position_fix]
rate_hz = 1.0
[sensors.rangefinder]
max_range_m = 1000.0
[sensors.optical_flow]
[sensors.wind_report]
rate_hz = 1.0
[[fault]]
sensor = "gnss"
channel = "north"
kind = "step"
size = 10.0
window = [1, 2]
[[estimator]]
name = "ins"
aids = ["gnss", "barometer", "magnetometer", "airspeed"]
"""


def record_format() -> str:
    """Groups and variables of a record, from one that is made for it."""
    from testbed import Scenario, run

    tree = run(Scenario.parse(RECORDED)).dataset
    labels = {name: v for path in tree.groups for name, v in tree[path].coords.items() if v.dims == (name,)}
    parts = ["Attributes of the file: " + ", ".join(f"`{name}`" for name in tree.attrs) + "."]
    told: set[str] = set()
    for path in sorted(tree.groups, key=_order_of_groups):
        shown = re.sub(r"^/estimators/\w+", "/estimators/<name>", path)
        shown = re.sub(r"innovations/\w+", "innovations/<measurement>", shown)
        variables = tree[path].to_dataset(inherit=False).data_vars
        rows = [
            (f"`{name}`", ", ".join(map(str, v.dims)) or "–", v.attrs.get("units", ""), v.attrs.get("long_name", ""))
            for name, v in variables.items()
        ]
        if rows and shown not in told:
            told.add(shown)
            head = ("variable", "dimensions", "units", "what it is")
            parts.append(f"### `{shown.lstrip('/')}`\n\n" + _table(head, rows))
    named = [
        (f"`{name}`", ", ".join(map(str, v.values))) for name, v in sorted(labels.items()) if v.dtype.kind in "OUT"
    ]
    parts.append("### Names along dimensions\n\n" + _table(("dimension", "in order"), named))
    return "\n\n".join(parts)


def export_formats() -> str:
    """What a record can be turned into, and a scenario."""
    from testbed.bridges.files import FILES
    from testbed.exports import FORMATS

    rows = []
    for one in (*FORMATS.values(), *FILES.values()):
        extra = f" (extra `{one.extra}`)" if one.extra else ""
        rows.append((f"`{one.name}`", one.holds + extra, one.readers))
    return _table(("format", "what is in it", "who reads it"), rows)


def _order_of_groups(path: str) -> tuple[int, str]:
    order = ("truth", "sensors", "estimators", "events", "faults")
    top = path.strip("/").partition("/")[0]
    return (order.index(top) if top in order else len(order), path)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        "| " + " | ".join(" ".join(str(cell).replace("|", "\\|").split()) for cell in line) + " |" for line in lines
    )


def _grade_part(kind: str) -> Callable[[], str]:
    return lambda: grade_tables()[kind]


KINDS = (
    "imu",
    "gnss",
    "magnetometer",
    "barometer",
    "airspeed",
    "body_velocity",
    "star_tracker",
    "position_fix",
    "rangefinder",
    "optical_flow",
    "wind_report",
)
PARTS: dict[str, Callable[[], str]] = {
    "scenario_reference": scenario_reference,
    "fault_kinds": fault_kinds,
    "fault_channels": fault_channels,
    "shipped_scenarios": shipped_scenarios,
    "metric_names": metric_names,
    "commands": commands,
    "conventions": conventions,
    "aircraft_modes": aircraft_modes,
    "envelopes": envelopes,
    "record_format": record_format,
    "export_formats": export_formats,
    **{f"grades_{kind}": _grade_part(kind) for kind in KINDS},
}


# --- hooks of MkDocs


def on_files(files: Any, config: Any) -> Any:
    """The figures beside the scenarios belong to the manual too."""
    from mkdocs.structure.files import File

    for path in sorted((ROOT / "scenarios").rglob("*.png")):
        files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    return files


def with_examples(markdown: str) -> str:
    """A page with the files of `docs/examples` that it names."""

    def block(found: re.Match[str]) -> str:
        return f'```python title="{found[1]}"\n{(ROOT / "docs/examples" / found[1]).read_text("utf-8")}```'

    return EXAMPLE.sub(block, markdown)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put in examples, and what is generated."""
    markdown = with_examples(markdown)
    return PLACEHOLDER.sub(lambda found: PARTS[found[1]](), markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Equations as MathML."""
    from latex2mathml.converter import convert

    def mathml(found: re.Match[str]) -> str:
        text = html.unescape(found[2]).strip()
        display = text.startswith(r"\[")
        return str(convert(text[2:-2].strip(), display="block" if display else "inline"))

    return re.sub(r'<(span|div) class="arithmatex">(.*?)</\1>', mathml, content, flags=re.DOTALL)
