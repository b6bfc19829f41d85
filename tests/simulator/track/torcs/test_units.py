"""Units and numbers of TORCS track files, against definitions from elsewhere."""

import math
from pathlib import Path

import pytest

from simulator.track.errors import TrackError
from simulator.track.torcs.torcs import read_torcs
from simulator.track.torcs.units import UNITS, parse_unit

STADIUM = (Path(__file__).parents[1] / "fixtures" / "sticky-grade.xml").read_text()
POUND, INCH, GRAVITY = 0.45359237, 0.0254, 9.80665  # exact by definition
DEFINED = {
    "m": 1.0,
    "km": 1e3,
    "cm": 1e-2,
    "mm": 1e-3,
    "in": INCH,
    "inch": INCH,
    "inches": INCH,
    "ft": 12 * INCH,
    "feet": 12 * INCH,
    "rad": 1.0,
    "deg": math.tau / 360,
    "%": 1 / 100,
    "percent": 1 / 100,
    "s": 1.0,
    "h": 60 * 60.0,
    "hour": 60 * 60.0,
    "hours": 60 * 60.0,
    "day": 24 * 60 * 60.0,
    "days": 24 * 60 * 60.0,
    "kg": 1.0,
    "lb": POUND,
    "lbs": POUND,
    "slug": POUND * GRAVITY / (12 * INCH),
    "slugs": POUND * GRAVITY / (12 * INCH),
    "N": 1.0,
    "lbf": POUND * GRAVITY,
    "Pa": 1.0,
    "kPa": 1e3,
    "MPa": 1e6,
    "psi": POUND * GRAVITY / INCH**2,
    "PSI": POUND * GRAVITY / INCH**2,
    "rpm": math.tau / 60,
    "RPM": math.tau / 60,
    "mph": 5280 * 12 * INCH / 3600,
    "MPH": 5280 * 12 * INCH / 3600,
}
# TORCS's own factors that differ from the definition by more than their rounding.
OFF_BY = {"ft": 3.3e-6, "feet": 3.3e-6, "slug": 6.5e-5, "slugs": 6.5e-5, "psi": 5e-7, "PSI": 5e-7}


def factor(text: str) -> float:
    unit = parse_unit(text)
    return 1.0 if unit is None else unit.factor


def test_every_name_has_the_factor_of_its_definition() -> None:
    assert set(UNITS) == set(DEFINED)
    for name, value in DEFINED.items():
        assert factor(name) == pytest.approx(value, rel=OFF_BY.get(name, 2e-9)), name
    # Where TORCS differs, its factor is used.
    assert (factor("ft"), factor("slug"), factor("psi")) == (0.304801, 14.59484546, 6894.76)


@pytest.mark.parametrize(
    ("text", "value", "dimension"),
    [
        ("kg.m/s2", 1.0, (1, 1, -2)),
        ("N.m", 1.0, (2, 1, -2)),
        ("lbf/in", POUND * GRAVITY / INCH, (0, 1, -2)),
        ("lbs.ft2", POUND * 0.304801**2, (2, 1, 0)),
        ("km/h", 1000.0 / 3600.0, (1, 0, -1)),
        ("m/s/s", 1.0, (1, 0, -2)),
        ("m/h.s", 1.0 / 3600.0, (1, 0, -2)),  # all behind the "/" divides
        ("km2/m", 1e6, (1, 0, 0)),
        ("/s", 1.0, (0, 0, -1)),
        ("deg/s", math.radians(1.0), (0, 0, -1)),
        ("N/%", 100.0, (1, 1, -2)),
        (" mm ", 1e-3, (1, 0, 0)),
    ],
)
def test_products_quotients_and_squares(
    text: str, value: float, dimension: tuple[int, int, int]
) -> None:
    unit = parse_unit(text)
    assert unit is not None
    assert unit.factor == pytest.approx(value)
    assert unit.dimension == dimension


@pytest.mark.parametrize("text", ["M", "Deg", "KM", "yard", "m3", "m^2", "m s", "µm", "1", "m.x"])
def test_unknown_names_are_refused(text: str) -> None:
    with pytest.raises(KeyError):
        parse_unit(text)


def read(tmp_path: Path, old: str, new: str) -> float:
    """The length of the stadium with `old` replaced by `new`: 200 m of straights, 2 half circles of
    50 m radius."""
    assert old in STADIUM
    path = tmp_path / "stadium.xml"
    path.write_text(STADIUM.replace(old, new), encoding="utf-8")
    return read_torcs(path).length_m


LENGTH = 'name="lg" val="100" unit="m"'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (LENGTH, 'name="lg" val="0.1" unit="km"'),
        (LENGTH, 'name="lg" val="10000" unit="cm"'),
        (LENGTH, 'name="lg" val="1e5" unit="mm"'),
        (LENGTH, f'name="lg" val="{100 / INCH}" unit="inches"'),
        (LENGTH, f'name="lg" val="{100 / 0.304801}" unit="feet"'),
        (LENGTH, 'name="lg" val="100" unit=""'),
        (LENGTH, 'name="lg" val="100" unit=" m "'),
        (LENGTH, 'name="lg" val=" +1.e2 "'),
        (LENGTH, 'name="lg" val="0x64" unit="m"'),
        (LENGTH, 'name="lg" val="0.1" unit="km2/km"'),
        ('name="arc" val="180" unit="deg"', f'name="arc" val="{math.pi!r}" unit="rad"'),
        ('name="arc" val="180" unit="deg"', f'name="arc" val="{math.pi!r}"'),
        ('name="arc" val="180" unit="deg"', f'name="arc" val="{100 * math.pi!r}" unit="percent"'),
    ],
)
def test_a_track_in_other_units_is_the_same(tmp_path: Path, old: str, new: str) -> None:
    assert read(tmp_path, old, new) == pytest.approx(200.0 + 100.0 * math.pi, abs=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (LENGTH, 'name="lg" val="100" unit="deg"', "lg has the unit 'deg', expected a length"),
        (LENGTH, 'name="lg" val="100" unit="%"', "lg has the unit '%', expected a length"),
        (LENGTH, 'name="lg" val="100" unit="m2"', "expected a length"),
        (LENGTH, 'name="lg" val="100" unit="M"', "TORCS has no 'M'; it has m, km, cm"),
        ('val="180" unit="deg"', 'val="3" unit="m"', "arc has the unit 'm', expected an angle"),
        ('val="180" unit="deg"', 'val="180" unit="Deg"', "TORCS has no 'Deg'"),
        (LENGTH, 'name="lg" val="100,0" unit="m"', "lg is '100,0', expected a finite number"),
        (LENGTH, 'name="lg" val="" unit="m"', "lg is ''"),
        (LENGTH, 'name="lg" val="1_00" unit="m"', "lg is '1_00'"),
        (LENGTH, 'name="lg" val="100m"', "lg is '100m'"),
        (LENGTH, 'name="lg" val="\u0661\u0660\u0660"', "lg is '\u0661\u0660\u0660'"),
        (LENGTH, 'name="lg" val="1e999"', "lg is '1e999'"),
        (LENGTH, 'name="lg" val="-0x64"', "lg is '-0x64'"),
    ],
)
def test_wrong_kinds_and_numbers_are_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(TrackError) as caught:
        read(tmp_path, old, new)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
