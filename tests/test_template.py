"""A scene as TOML to edit: complete, commented, and the same scene again; and single settings changed by name."""

import dataclasses
import tomllib
from dataclasses import dataclass, field

import pytest

from semsim import template
from semsim.errors import InputError
from semsim.overrides import assignment, overridden, setting, value_of
from semsim.scene import Scene, tables
from semsim.scenes import NAMED, load_scene, scene
from semsim.specimens import SPECIMENS
from semsim.template import commented_table, commented_toml, explanations, inline, unit


@pytest.mark.parametrize("name", NAMED)
def test_a_printed_scene_is_the_scene(name, tmp_path):
    path = tmp_path / "printed.toml"
    path.write_text(commented_toml(scene(name)), encoding="utf-8")
    assert load_scene(path) == scene(name)


def test_changed_settings_are_printed_too(tmp_path):
    changed = overridden(
        scene("plane"), {"detector.gain_per_e": 0.25, "schedule.shifts_um": [[0, 0], [1, 0], [2, 0.5]]}
    )
    path = tmp_path / "printed.toml"
    path.write_text(commented_toml(changed), encoding="utf-8")
    assert load_scene(path) == changed


@pytest.mark.parametrize("name", NAMED)
def test_every_field_of_every_table_is_there_under_a_comment_of_its_own(name):
    lines = commented_toml(scene(name)).splitlines()
    tables = dict(dataclasses_in(Scene, scene(name)))
    for path, kind in tables.items():
        start = next(i for i, line in enumerate(lines) if line.lstrip("#") == f"[{path}]") if path else 0
        end = next((i for i in range(start + 1, len(lines)) if lines[i].startswith(("[", "#["))), len(lines))
        for entry in dataclasses.fields(kind):
            if f"{path}.{entry.name}".lstrip(".") in tables:
                continue
            (row,) = (i for i in range(start, end) if lines[i].lstrip("#").startswith(f"{entry.name} ="))
            told = explanations(kind)[entry.name]
            above = " ".join(line[2:] for line in lines[start:row] if line.startswith("# "))
            assert told in above
            assert unit(entry.name) in above[above.rindex(told) :]


def dataclasses_in(kind, value, path=""):
    """Yield the path and the kind of each dataclass that a scene holds or may hold, itself included."""
    yield path, kind
    may_hold = template._tables_within(kind)
    for entry in dataclasses.fields(kind):
        inner = getattr(value, entry.name, None)
        found = type(inner) if dataclasses.is_dataclass(inner) else may_hold.get(entry.name)
        if found is not None:
            yield from dataclasses_in(found, inner, f"{path}.{entry.name}".lstrip("."))


@pytest.mark.parametrize("kind", SPECIMENS, ids=lambda kind: kind.name)
def test_every_option_of_a_specimen_is_explained(kind):
    options = {each.name for each in dataclasses.fields(kind)}
    assert options <= set(explanations(kind))
    table = tomllib.loads(commented_table(kind, "specimen"))["specimen"]
    assert table["name"] == kind.name
    assert options - set(table) == {each for each in options if getattr(kind(), each) is None}


@dataclass(frozen=True)
class Leaf:
    """A leaf.

    Parameters
    ----------
    width_um : float
        Across.
    height_um, depth_um
        Up, and in:
        both.

    Raises
    ------
    InputError
        Never.
    """

    width_um: float
    height_um: float = 2.0
    depth_um: float | None = None


@dataclass(frozen=True)
class Twig:
    """A twig of leaves.

    Parameters
    ----------
    name
        Its name.
    always, never, many
        Leaves.
    """

    name: str = 'a "twig"'
    always: Leaf = field(default_factory=lambda: Leaf(1.0))
    never: Leaf | None = None
    many: tuple[Leaf, ...] = ()


def test_tables_within_tables_optional_ones_and_lists_of_them():
    text = commented_table(Twig, "tree.twig")
    assert tomllib.loads(text) == {
        "tree": {"twig": {"name": 'a "twig"', "always": {"width_um": 1.0, "height_um": 2.0}}}
    }
    lines = text.splitlines()
    assert {"#[tree.twig.never]", "#[[tree.twig.many]]", "#height_um = 2.0", "#depth_um = "} <= set(lines)
    assert lines[lines.index("height_um = 2.0") - 1] == "# Up, and in: both. [um; default 2.0]"
    assert lines[lines.index("width_um = 1.0") - 1] == "# Across. [um; required]"


def test_what_is_off_is_switched_on_by_taking_the_marks_away():
    lines = commented_table(Twig, "twig").splitlines()
    on = [
        line[1:] if line.startswith("#") and not line.startswith(("# ", "#width", "#depth")) else line for line in lines
    ]
    assert tomllib.loads("\n".join(on))["twig"]["never"] == {"height_um": 2.0}


@pytest.mark.parametrize("name", NAMED)
def test_all_that_is_off_in_a_scene_can_be_switched_on(name, tmp_path):
    lines = commented_toml(scene(name)).splitlines()
    on = [
        line[1:] if line.startswith("#") and not line.startswith("# ") and not line.endswith("= ") else line
        for line in lines
    ]
    path = tmp_path / "on.toml"
    path.write_text("\n".join(on), encoding="utf-8")
    loaded = load_scene(path)
    for table in (line[2:-1] for line in lines if line.startswith("#[")):
        assert isinstance(setting(scene(name), table), type(None))
        assert isinstance(setting(loaded, table), dict)


def test_a_list_of_tables_is_written_as_such():
    twig = Twig(many=(Leaf(3.0), Leaf(4.0, depth_um=1.0)))
    text = "\n".join(template._table(Twig, template._values(twig), "twig"))
    assert tomllib.loads(text)["twig"]["many"] == [
        {"width_um": 3.0, "height_um": 2.0},
        {"width_um": 4.0, "height_um": 2.0, "depth_um": 1.0},
    ]


@pytest.mark.parametrize("value", [1, -2.5, 1e-9, 1e22, True, 'a "b" \\ µ\n', [], [1, [2.0, "c"]], {"a": [1]}])
def test_a_value_on_one_line_reads_back(value):
    line = f"x = {inline(value)}"
    assert "\n" not in line
    assert tomllib.loads(line)["x"] == value


def test_units_are_read_from_names():
    names = ("pixel_size_um", "gain_per_e", "bits", "tilts_deg", "dose_e", "shadow_reach_um", "line_time_s", "scale")
    assert [unit(name) for name in names] == ["um", "per electron", "", "degrees", "electrons", "um", "s", ""]


def test_a_setting_is_changed_and_nothing_else():
    before = scene("wedge")
    after = overridden(before, {"detector.dose_e": 50, "specimen.edge_um": 2.0, "specimen_seed": 7})
    expected = tables(before)
    expected["detector"]["dose_e"], expected["specimen"]["edge_um"], expected["specimen_seed"] = 50.0, 2.0, 7
    assert tables(after) == expected
    assert (
        overridden(after, {"detector.dose_e": "default", "specimen.edge_um": "default", "specimen_seed": 0}) == before
    )


def test_another_specimen_comes_with_its_own_options_whatever_the_order():
    made = overridden(scene("wedge"), {"specimen.radius_um": 30.0, "specimen.name": "sphere"})
    assert (made.specimen.name, made.specimen.radius_um, made.name) == ("sphere", 30.0, "wedge")


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"detector.dos_e": 50}, "unknown key dos_e"),
        ({"detektor.dose_e": 50}, "unknown key detektor"),
        ({"detector.dose_e": "much"}, "'much' is not a number"),
        ({"detector.dose_e": -1}, "dose_e"),
        ({"specimen.name": "moon"}, "no specimen 'moon'"),
        ({"specimen.depth_um": 3}, "no option 'depth_um'"),
        ({"name.first": "x"}, "name is a single value"),
        ({"schedule.tilts_deg": [95]}, "between -90 and 90"),
    ],
)
def test_a_setting_that_cannot_be_is_named(settings, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        overridden(scene("wedge"), settings)
    assert next(iter(settings)) in str(error.value)


def test_assignments_and_values_as_they_are_typed():
    assert assignment("detector.dose_e = 50") == ("detector.dose_e", "50")
    assert [value_of(text) for text in ("50", "[0, 5.0]", "view", '"5"')] == [50, [0, 5.0], "view", "5"]
    assert setting(scene("wedge"), "detector.bits") == 8
    assert setting(scene("wedge"), "detector.gain_per_e.x") is None
    for text in ("detector.dose_e", "=5", "detector.dose_e="):
        with pytest.raises(InputError, match=r"section\.key=value"):
            assignment(text)
