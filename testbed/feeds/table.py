"""A table as a log: .npz, .mat, .parquet or text. The scenario says what each column is (`testbed.motion.logged`)."""

from __future__ import annotations

import datetime as dt
import math
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nav.earth import isa_pressure
from nav.samples import Array, FixType, ImuSamples
from testbed.errors import UserError, choice, shown, unknown
from testbed.feeds import text
from testbed.feeds.clocks import Clocks
from testbed.feeds.doubted import contradicted
from testbed.feeds.earth_fixed import on_the_ellipsoid
from testbed.feeds.formats import known
from testbed.feeds.log import TABLE, Log, Reference, Samples, beginning, require_imu, require_one_clock
from testbed.feeds.reference import usual_sigma
from testbed.feeds.samples import Fixes, airspeeds, barometers, eas_of, magnetometers, newly, quaternions
from testbed.feeds.stamps import integrated, left_out, spaced, with_holes
from testbed.feeds.units import ANGLE, UNITS
from testbed.motion.logged import Column, Stream
from testbed.sensors.units import DEG

PARQUET = b"PAR1"
# As ISO 8601 has it, with a time of day; RTKLIB has slashes for its dashes.
DATE = re.compile(r"\s*\d{4}([-/])\d\d\1\d\d[T ]\d\d:\d\d")
DAY, CLOCK = re.compile(r"\d{4}[-/]\d\d[-/]\d\d"), re.compile(r"\d\d:\d\d:\d\d(\.\d+)?")  # in columns of their own
LONGEST_SHOWN = 30  # of what is no number
FASTEST, HARDEST = 1e3, 1e4  # [rad/s], [m/s^2]: three times what gyros of missiles measure, and a thousand g
WILD_SHARE = 0.01  # of the rows, that may be beyond these by damage

STEEPEST = math.radians(91)  # a pitch; one that is in degrees and said to be in radians is soon more
EDGE_RAD = 1e-3  # of a whole turn that is rounded
LARGEST = {"lat": math.pi / 2, "lon": 4 * math.pi}  # that there may be of these, with a turn too many
GARBAGE = 0.01  # share of rows that may be what no such quantity is
ANGLES_ALIKE = 'offset would be added to roll, pitch and heading alike: of angles to other axes say frame = "flu-enu"'
QUATERNION = (
    "a quaternion has no offset or axes: name its columns in the order w, x, y, z, such as"
    ' column = ["q:3", "q:0", "q:1", "q:2"] of one that has w last, and say with frame what it turns between'
)
CODES = "and are taken to be without a fix: leave fix out where it is another code, as RTKLIB's Q or NMEA's quality"
NOWHERE = "are without height, or at latitude and longitude 0"
VECTORS = frozenset({"gyro", "accel", "position", "velocity", "sigma_position", "sigma_velocity", "field"})
# What each kind needs, one of each tuple, and what it may have.
NEEDED: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "imu": (("gyro",), ("accel",)),
    "gnss": (("lat", "position"), ("lon", "position"), ("height", "position")),
    "barometer": (("pressure", "height"),),
    "magnetometer": (("field",),),
    "airspeed": (("airspeed", "pressure"),),
    "reference": (),
}
OPTIONAL: Mapping[str, tuple[str, ...]] = {
    "gnss": ("velocity", "sigma_position", "sigma_velocity", "fix", "satellites", "hdop", "vdop"),
    "reference": ("lat", "lon", "height", "position", "velocity", "attitude", "sigma_position", "sigma_velocity"),
}


class Table(NamedTuple):
    """A file: its columns of ``numbers``, each (N,) or (N, k), by name, and what the ``others`` hold, a few words.

    Those that were ``dates`` are seconds since 1970.
    """

    path: Path
    numbers: Mapping[str, Array]
    others: Mapping[str, str]
    dates: frozenset[str] = frozenset()


class Tables(NamedTuple):
    """What was read of each file, and the one that columns are in unless they name another."""

    of_files: Mapping[Path, Table]
    main: Path


def read(path: Path, columns: Mapping[str, Stream]) -> Log:
    """Read a table, and those of sensors and of quantities that have their own, by their ``columns``.

    Raises UserError when one, or what is said of it, is wrong.
    """
    named = [Path(file) for stream in columns.values() for file in stream.files.values()]
    of_files = {file: load(file) for file in dict.fromkeys([path, *named])}
    found = {
        name if file == path else f"{name} of {file.name}": len(values)
        for file, table in of_files.items()
        for name, values in table.numbers.items()
    }
    if not columns:
        there = ", ".join(f"{name} {values.shape}" for name, values in of_files[path].numbers.items())
        raise UserError(
            f"{path}: is a table: say in [truth.columns.<sensor>] what its columns are. It has {there or 'none'}"
        )
    notes: list[str] = []
    imus: dict[str, ImuSamples] = {}
    samples: dict[str, Samples] = {}
    reference = None
    clocks = Clocks()
    # Inertial units first: what is held on at their times is known by them.
    for name, stream in sorted(columns.items(), key=lambda one: (one[1].kind or one[0]) != "imu"):
        kind = stream.kind or name
        clocks.heard = (
            next(((imu.t[0], imu.t[-1]) for imu in imus.values() if len(imu)), None) if kind != "imu" else None
        )
        t, values = quantities(Tables(of_files, path), name, kind, stream, clocks, notes)
        if kind == "imu":
            t, values = _whole(name, t, values, stream, notes)
            imu = integrated(t, values["gyro"], values["accel"], stream.form)
            imus[name] = with_holes(name, imu, notes) if stream.form == "increments" else imu
        elif kind == "reference":
            reference = known_motion(*newly(name, t, values, imus, notes), notes)
        else:
            samples[name] = _samples(name, kind, *newly(name, t, values, imus, notes), notes)
    require_imu(path, imus, found, 'columns of time, gyro and accel of a sensor of kind "imu"', notes)
    require_one_clock(path, imus, samples)
    start = beginning(imus, samples, reference, notes)
    remark = contradicted(reference, imus, samples)
    date = _date(of_files, path, columns.values(), start)
    return Log(path, TABLE, imus, samples, reference, start, found, notes, date=date, remark=remark)


def _date(tables: Mapping[Path, Table], main: Path, streams: Iterable[Stream], start: float) -> dt.date | None:
    """The date in UTC at which a log begins, ``start`` of its clock, None where no sensor's time is a date."""
    for stream in streams:
        column = stream.time
        if column.column in tables[Path(column.file or stream.file or main)].dates:
            return dt.datetime.fromtimestamp(start, dt.UTC).date()
    return None


def _whole(
    name: str, t: Array, values: dict[str, Array], stream: Stream, notes: list[str]
) -> tuple[Array, dict[str, Array]]:
    """Rates and forces without the rows that lack one of them, or have one that nothing turns or is pushed by.

    A lost increment is missing, and stays so.
    """
    if stream.form == "increments":
        return t, values
    known = np.isfinite(values["gyro"]).all(axis=1) & np.isfinite(values["accel"]).all(axis=1)
    felt = np.abs(np.hstack([values["gyro"] / FASTEST, values["accel"] / HARDEST]))
    wild = known & np.asarray((felt > 1).any(axis=1))
    if wild.sum() > WILD_SHARE * len(t):  # it is the unit that is wrong
        wild = np.zeros(len(t), bool)
    for rows, what in ((~known, "have no rate or no specific force"), (wild, "turn or push harder than anything does")):
        if lacking := int(rows.sum()):
            told = f"{lacking} of {len(t)} rows {what}: left out"
            notes.append(left_out(name, told, lacking, len(t)))
    known &= ~wild
    return t[known], {key: one[known] for key, one in values.items()}


def load(path: Path) -> Table:
    """The columns of a file. Raises UserError when it can't be read, or is a log of another format."""
    if (found := known(path)).module != "table":
        raise UserError(f"{path}: is {found.name}, and no table")
    with path.open("rb") as file:
        head = file.read(16)
    try:
        if head.startswith(b"PK"):
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return _sorted(path, arrays.items())
        if head.startswith(b"MATLAB"):
            from scipy.io import loadmat

            return _sorted(path, _flat(loadmat(path, simplify_cells=True)))
        if head.startswith(PARQUET):
            import pandas

            frame = pandas.read_parquet(path, engine="pyarrow")
            if not isinstance(frame.index, pandas.RangeIndex) and not {*frame.index.names} & {*frame.columns}:
                frame = frame.reset_index()  # often of times
            return _sorted(path, ((str(name), _values(frame[name])) for name in frame.columns))
        return _sorted(path, text.columns(path))
    except UserError:
        raise
    except ImportError:
        raise UserError(f"{path}: is Parquet, for which pyarrow is needed: pip install pyarrow") from None
    except (ValueError, TypeError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: can't be read as a table: {str(error).splitlines()[0][:200]}") from None
    except Exception as error:  # of a file cut anywhere: zlib.error, struct.error and the like of three libraries
        raise UserError(f"{path}: is damaged: {type(error).__name__} {str(error)[:200]}") from None


def _values(column: Any) -> Any:
    """The values of a pandas column: dates of any time zone in UTC, lists that are equally long as (N, k)."""
    values = (column.dt.tz_convert(None) if getattr(column.dtype, "tz", None) else column).to_numpy()
    lists = values.dtype == object and all(isinstance(one, np.ndarray) for one in values)
    return np.stack(values) if lists and len({len(one) for one in values}) == 1 else values


def _sorted(path: Path, columns: Iterable[tuple[str, Any]]) -> Table:
    """Those that hold numbers, as floats, and the others. A time of day goes with the date in the column before it."""
    numbers, others, dates = {}, {}, set()
    before = np.empty(0)
    for name, values in columns:
        read = np.asarray(values)
        array = _seconds(_dated(read, before))
        before = read
        if array is not read:
            dates.add(name)
        if array.ndim in (1, 2) and array.dtype.kind in "fiub":
            numbers[name] = array.astype(float)
        elif array.ndim:
            others[name] = _instead(array)
    return Table(path, numbers, others, frozenset(dates))


def _dated(clock: Any, day: Any) -> Any:
    """Times of day with the dates (N,) that are their own, as ISO 8601 has them; any other column as it is."""
    apart = DAY.fullmatch(_first_text(day)) and CLOCK.fullmatch(_first_text(clock))
    if not apart or day.shape != clock.shape:
        return clock
    both = [isinstance(one, str) and isinstance(time, str) for one, time in zip(day, clock, strict=True)]
    said = [f"{one}T{time}".replace("/", "-") for one, time in zip(day, clock, strict=True)]
    return np.array([one if known else None for one, known in zip(said, both, strict=True)], object)


def _first_text(array: Any) -> str:
    """What the first row of a column that is text says."""
    if array.ndim != 1 or array.dtype.kind not in "OUT":
        return ""
    return next((one for one in array if isinstance(one, str)), "")


def _seconds(array: Any) -> Any:
    """Dates and times of day, which are UTC where they don't say, as seconds since 1970; any other column as it is."""
    if array.ndim != 1:
        return array
    dated = DATE.match(_first_text(array))
    if not (array.dtype.kind == "M" or dated):
        return array
    import pandas

    said = pandas.Series(array)
    if dated and dated[1] == "/":
        said = said.str.replace("/", "-")
    try:
        times = pandas.to_datetime(said, format="ISO8601", utc=True)
    except ValueError:
        return array
    since = times - pandas.Timestamp(0, tz="UTC")
    return since.dt.total_seconds().to_numpy()


def _instead(array: Any) -> str:
    """What a column holds that are no numbers."""
    if array.dtype.kind in "mM":
        return f"holds {array.dtype}: give seconds as numbers"
    if array.ndim > 1 or array.dtype.kind not in "OUST":
        return f"holds {array.dtype} of shape {array.shape}"
    if not len(array):
        return "has no rows"
    for k, one in enumerate(array):
        if not _is_number(one):
            said = str(one)
            return f"holds text, first {shown(said[:LONGEST_SHOWN])} in row {k + 1}{text.advice(said)}"
    return "holds numbers as text"


def _is_number(value: Any) -> bool:
    """Whether it is one, or nothing at all."""
    try:
        float(value)
    except (TypeError, ValueError):
        return value is None
    return True


def _flat(tree: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Variables of a MATLAB file, those in structs as ``struct.field``."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}.")
        elif not name.startswith("__"):
            yield before + name, value


def quantities(
    tables: Tables, name: str, kind: str, stream: Stream, clocks: Clocks, notes: list[str]
) -> tuple[Array, dict[str, Array]]:
    """Ascending times and the quantities of one sensor, SI. Raises UserError when it has not what its kind needs.

    ``clocks`` are those of the sensors before it.
    """
    where = f"truth.columns.{name}"
    if kind not in NEEDED:
        raise UserError(f"{where}: {unknown('kind', kind, list(NEEDED))}")
    usual = {key for keys in NEEDED[kind] for key in keys} | set(OPTIONAL.get(kind, ()))
    given = {key: column for key, column in stream.columns.items() if key != "time"}
    for key in given:
        if key not in usual:
            raise UserError(f"{where}.{key}: is nothing that a sensor of kind {kind} has: {choice(key, sorted(usual))}")
    for keys in NEEDED[kind]:
        if not any(key in given for key in keys):
            raise UserError(f"{where}.{keys[0]}: is missing: a sensor of kind {kind} needs {' or '.join(keys)}")
        if len(keys) > 1 and all(key in given for key in keys):
            raise UserError(f"{where}.{keys[1]}: is given beside {keys[0]}: say one of {' and '.join(keys)} only")
    values = {}
    for key, column in (given | {"time": stream.time}).items():
        table = tables.of_files[Path(column.file or stream.file or tables.main)]
        values[key] = _quantity(table, f"{where}.{key}", key, column, notes)
    stamps = values.pop("time")
    for key, array in values.items():
        if len(array) != len(stamps):
            raise UserError(f"{where}.{key}: has {len(array)} rows, and its time has {len(stamps)}")
    if not len(stamps):
        raise UserError(f"{where}.time: has no rows")
    values = on_the_ellipsoid(where, stream, values)
    blank = np.all([np.isnan(array).reshape(len(array), -1).all(axis=1) for array in values.values()], axis=0)
    rows = np.flatnonzero(~blank)  # a table of several sensors is blank where one says nothing
    apart = spaced(name, stamps[rows], notes) if stream.form == "increments" else stamps[rows]
    source = (stream.time.file or stream.file, stream.time)
    t, kept = clocks.ordered(name, source, rows, apart, notes)
    return t, {key: array[rows[kept]] for key, array in values.items()}


def _quantity(table: Table, where: str, key: str, column: Column, notes: list[str]) -> Array:
    """One quantity in SI units and house axes: (N,), or (N, 3), of an attitude (N, 4)."""
    units = UNITS[key]
    unit = next(iter(units)) if column.unit is None else column.unit
    if unit not in units:
        raise UserError(f"{where}: {unknown('unit', unit, list(units))}")
    names = (column.column,) if isinstance(column.column, str) else column.column
    parts = [_column(table, where, one) for one in names]
    if len({len(part) for part in parts}) > 1:
        raise UserError(f"{where}: its columns differ in length")
    values = parts[0] if len(parts) == 1 else np.column_stack(parts)
    width = 1 if values.ndim == 1 else values.shape[1]
    if key == "time" and width == 2 and column.unit in (None, "s") and _are_seconds_and_nanoseconds(values):
        values, width = values[:, 0] + 1e-9 * values[:, 1], 1
    wanted = (3, 4) if key == "attitude" else (3,) if key in VECTORS else (1,)
    if width not in wanted:
        raise UserError(f"{where}: has {width} columns: {' or '.join(map(str, wanted))} are needed")
    if key == "attitude":
        return _attitude(where, values, column, notes)
    values = (values * column.scale) * units[unit] + column.offset * units[unit]
    if width == 3:
        order, signs = column.order
        return np.ascontiguousarray(values[:, order] * (np.abs(signs) if key.startswith("sigma") else signs))
    values = values.reshape(len(values))
    if key in LARGEST:
        _require_unit(where, values / units[unit], unit, LARGEST[key])
    return values


def _are_seconds_and_nanoseconds(values: Array) -> bool:
    """Whether two columns (N, 2) are a time as ROS has it."""
    seconds, nanoseconds = values.T
    whole = np.all(np.mod(values, 1) == 0) and np.all((nanoseconds >= 0) & (nanoseconds < 1e9))
    return bool(whole and nanoseconds.max(initial=0.0) > 1e6 and np.all(np.diff(seconds) >= 0))


def _require_unit(where: str, values: Array, unit: str, largest: float) -> None:
    """Raise UserError when angles in a ``unit`` are mostly larger than the ``largest`` [rad]: it is another one."""
    known = np.abs(values[np.isfinite(values) & (values != 0)])
    usual = float(np.median(known)) if len(known) else 0.0
    if usual * ANGLE[unit] > largest:
        meant = "deg" if usual * DEG <= largest else "1e-7deg"
        raise UserError(f'{where}: is {usual:.6g} {unit}: unit = "{meant}"?')


def _attitude(where: str, values: Array, column: Column, notes: list[str]) -> Array:
    """Attitudes q_nb (N, 4) of angles (N, 3) or quaternions (N, 4) as the table has them."""
    if values.shape[1] == 4:
        if column.offset or column.axes != ("x", "y", "z"):
            raise UserError(f"{where}: {QUATERNION}")
        length = np.linalg.norm(column.scale * values, axis=1, keepdims=True)
        if none := int(np.sum(length == 0)):
            notes.append(f"{where.removeprefix('truth.columns.')}: {none} quaternions are of no length, and unknown")
        return _turned(column.scale * values / np.where(length > 0, length, np.nan), column.frame)
    if column.offset:
        raise UserError(f"{where}: {ANGLES_ALIKE}")
    order, signs = column.order
    roll, pitch, heading = (values[:, order] * signs * column.scale * ANGLE[column.unit or "rad"]).T
    # As from 0 to a whole turn too, but no more of them: what is in degrees and said to be in radians is.
    steep = np.abs(np.mod(pitch + math.pi, 2 * math.pi) - math.pi) > STEEPEST
    if (column.unit or "rad") == "rad" and np.mean(steep | (np.abs(pitch) > 2 * math.pi + EDGE_RAD)) > GARBAGE:
        raise UserError(f'{where}: has a pitch of {np.nanmax(np.abs(pitch)):.3g} rad: unit = "deg"?')
    return _turned(quaternions(roll, pitch, heading), column.frame)


def _turned(q: Array, frame: str) -> Array:
    """Quaternions (N, 4) of body axes and axes of the Earth of a ``frame`` as those of house axes, q_nb."""
    if frame == "frd-ned":
        return q
    w, x, y, z = q.T  # half a turn about the line between north and east before it, and one about forward after it
    return np.asarray(np.column_stack([w + z, x + y, x - y, w - z]) * math.sqrt(0.5))


def _column(table: Table, where: str, name: str) -> Array:
    """A column by its name, or one of an array's by ``name:number``."""
    found = table.numbers
    if name in found:
        return found[name]
    if name in table.others:
        raise UserError(f"{where}: {name} of {table.path} {table.others[name]}")
    whole, _, number = name.rpartition(":")
    if whole in found and number.isdecimal() and found[whole].ndim == 2 and int(number) < found[whole].shape[1]:
        return found[whole][:, int(number)]
    raise UserError(f"{where}: {unknown('column', name, list(found))}")


def _samples(name: str, kind: str, t: Array, values: Mapping[str, Array], notes: list[str]) -> Samples:
    """The samples of one aiding sensor."""
    match kind:
        case "barometer":
            pressure = values.get("pressure")
            return barometers(name, t, isa_pressure(values["height"]) if pressure is None else pressure)
        case "magnetometer":
            return magnetometers(name, t, values["field"], notes)
        case "airspeed":
            eas = values.get("airspeed")
            return airspeeds(name, t, eas_of(values["pressure"]) if eas is None else eas)
    lat, lon, height = values["lat"], values["lon"], values["height"]
    if (fix := values.get("fix")) is None:
        nowhere = (lat == 0) & (lon == 0)
        if nowhere.any():
            notes.append(f"{name}: {np.sum(nowhere)} rows are at latitude and longitude 0: taken to be without a fix")
            lat = np.where(nowhere, np.nan, lat)
    elif 2 * (refused := int(np.sum(np.isfinite(lat) & ~(fix >= FixType.FIX_3D)))) > len(t):
        notes.append(f"{name}: {refused} of {len(t)} rows have fix < 3, {CODES}")
    fixes = Fixes(t, lat, lon, height)
    for key, own in (
        ("velocity", "v_n"),
        ("sigma_position", "sigma_position_n"),
        ("sigma_velocity", "sigma_velocity_n"),
    ):
        if key in values:
            setattr(fixes, own, values[key])
    for key in ("fix", "satellites", "hdop", "vdop"):
        if key in values:
            setattr(fixes, key, values[key])
    return fixes.samples(name, notes)


def known_motion(t: Array, values: Mapping[str, Array], notes: list[str]) -> Reference:
    """What the table says of the motion: where there is no whole place, or that of zeros, it is unknown.

    It is as good as it says, in the median of its rows.
    """
    named = {"height": "h", "velocity": "v_n", "attitude": "q_nb"}
    columns = {named.get(key, key): array for key, array in values.items()}
    place = {key: columns.pop(key) for key in ("lat", "lon", "h") if key in columns}
    sigma = [usual_sigma(columns.pop(key, np.empty((0, 3)))) for key in ("sigma_position", "sigma_velocity")]
    if len(place) == 3:
        lat, lon, h = place.values()
        nowhere = (lat == 0) & (lon == 0)
        known = np.isfinite(lat + lon + h) & ~nowhere
        if strange := int(np.sum(~known & np.isfinite(lat))):
            notes.append(f"reference: {strange} of {len(t)} rows {NOWHERE}: its place is unknown there")
        if known.any():
            place["lon"] = np.mod(lon + math.pi, 2 * math.pi) - math.pi
            columns |= {key: np.where(known, array, np.nan) for key, array in place.items()}
        if "v_n" in columns:  # who does not know where it is knows no velocity
            columns["v_n"] = np.where(nowhere[:, None], np.nan, columns["v_n"])
    elif place:
        notes.append("reference: not all of lat, lon and height are said: nothing is judged by its place")
    return Reference("reference of the log", t, columns, *sigma)
