import json
import math
import os

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.sources.templates import Layout
from flexroad.pipeline.cli.configs import schema, template
from flexroad.pipeline.config.loading import compose, load_config, read_mapping, shipped
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.filter import planar


def test_paper_configuration_has_parameters_of_the_paper():
    chains = load_config("paper").chains
    assert list(chains) == ["plane", "rgt", "flexroad"]
    full = chains["flexroad"]
    assert (full["fit"].control_points, full["fit"].degree) == ((35, 35), 3)
    assert (full["fit"].learning_rate, full["fit"].iterations) == (0.1, 200)
    assert (full["ecsrc"].theta_xy_m, full["ecsrc"].theta_z_m) == (10, 0.5)
    assert (full["sample"].road_m, full["sample"].terrain_m) == (1, 10)
    assert chains["plane"]["fit"].method == "plane"
    assert chains["plane"]["sample"].method == "corners"
    assert chains["rgt"]["fit"].method == "raster"
    assert chains["rgt"]["sample"].method == "uniform"


def test_override_with_same_method_keeps_base_options():
    raw = {
        "fit": {"method": "nurbs", "degree": 5},
        "ecsrc": "planar",
        "variants": {"a": {"fit": {"iterations": 7}}, "b": {"fit": "plane", "ecsrc": "off"}, "c": None},
    }
    chains = compose(raw, "x").chains
    assert (chains["a"]["fit"].degree, chains["a"]["fit"].iterations) == (5, 7)
    assert chains["b"]["fit"].method == "plane"
    assert chains["c"]["fit"].degree == 5
    assert chains["c"]["ecsrc"] == planar.Options()
    assert chains["b"]["ecsrc"] == load_config("ablation").chains["wo_ecsrc"]["ecsrc"]


@pytest.mark.parametrize("text", ["", "# nothing\n", "cluster: {workers: 2}\n", "extends: production\n"])
def test_file_without_extends_is_production(tmp_path, text):
    (tmp_path / "mine.yaml").write_text(text)
    production = load_config("production")
    assert load_config(tmp_path / "mine.yaml").chains == production.chains
    (tmp_path / "heir.yaml").write_text("extends: mine.yaml\nload: {halo_m: 60}\n")
    chain = load_config(tmp_path / "heir.yaml").chains["flexroad"]
    assert (chain["load"].halo_m, chain["fit"]) == (60, production.chains["flexroad"]["fit"])


def test_extends_defaults_has_the_defaults_of_the_options(tmp_path):
    (tmp_path / "mine.yaml").write_text("extends: defaults\n")
    assert load_config(tmp_path / "mine.yaml").chains == compose({}, "x").chains
    (tmp_path / "mine.yaml").write_text("extends:\n")
    assert "extends: expected a file or a shipped name, not None" in refusal(tmp_path / "mine.yaml")


@pytest.mark.parametrize("name", shipped())
def test_configuration_of_a_run_is_complete(name, tmp_path):
    config = load_config(name)
    assert config.chains
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config.raw, sort_keys=False))
    again = load_config(tmp_path / "config.yaml")
    assert (again.chains, again.export, again.dataset) == (config.chains, config.export, config.dataset)


def test_file_keeps_the_options_that_it_leaves_out(tmp_path):
    (tmp_path / "base.yaml").write_text(
        "export: {formats: [npz], texture_px: 512}\n"
        "segment: {method: vector, class_width_m: {track: 9}}\n"
        "dataset: {crs: EPSG:25832, layers: {dsm: a.tif, dtm: b.tif}}\n"
    )
    (tmp_path / "mine.yaml").write_text(
        "extends: base.yaml\n"
        "export: {texture_px: 64}\n"
        "segment: {class_width_m: {service: 8}}\n"
        "dataset: {layers: {dsm: c.tif}}\n"
    )
    config = load_config(tmp_path / "mine.yaml")
    assert (config.export.formats, config.export.texture_px) == (("npz",), 64)
    widths = config.chains["flexroad"]["segment"].class_width_m
    assert (widths["track"], widths["service"]) == (9, 8)
    # The files of a dataset are of one dataset: another's layers are no part of it.
    assert config.dataset == {"crs": "EPSG:25832", "layers": {"dsm": "c.tif"}}


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"ecrsc": {}}, "x: ecrsc: unknown key; did you mean ecsrc?"),
        ({"ecsrc": {"theta_z": 0.5}}, "x: ecsrc.theta_z: unknown key; did you mean theta_z_m?"),
        ({"segment": {"method": "vector", "wher": ""}}, "x: segment.wher: unknown key; did you mean where?"),
        ({"fit": {"degre": 2}}, "x: fit.degre: unknown key; did you mean degree?"),
        ({"ecsrc": {"theta_z_m": -1}}, "x: ecsrc.theta_z_m: input should be greater than"),
        ({"fit": {"degree": "three"}}, "x: fit.degree: input should be a valid integer"),
        ({"fit": "nurb"}, "x: fit: "),
        (
            {"fit": {"huber_m": 0.1}},
            "x: fit.huber_m: unknown key; it is an option of method smoothing_spline, not of nurbs",
        ),
        ({"ecsrc": "plane"}, "x: ecsrc: there is no method 'plane'; did you mean planar?"),
        ({"cluster": {"batch": 4}}, "x: cluster.batch: unknown key; valid are flush, "),
        (
            {"fit": {"method": "smoothing_spline", "engine": "torch"}},
            "x: fit.engine: unknown key; it is an option of method nurbs, not of smoothing_spline",
        ),
        ({"fit": [1]}, "x: fit: expected a mapping of options, not [1]"),
        ({"load": 3}, "x: load: expected a mapping of options, not 3"),
        ({"fit": {"learning_rate": math.inf}}, "x: fit.learning_rate: input should be a finite number"),
        ({"variants": {"a/b": {}}}, "x: variants.a/b: the name is part of file names; use letters,"),
        ({"export": {"variants": []}}, "x: export.variants: tuple should have at least 1 item"),
        ({"variants": {"a": {"fitt": {}}}}, "x: variants.a.fitt: unknown key; did you mean fit?"),
        ({"variants": {"a": {"sample": {"road": 1}}}}, "x: variants.a.sample.road: unknown key"),
        ({"variants": ["a"]}, "x: variants: expected a mapping"),
        ({"export": {"variants": ["b"]}}, "x: export.variants: no variant 'b', only flexroad"),
        ({"export": ["glb"]}, "x: export: expected a mapping, not ['glb']"),
        (
            {"export": {"texture": True, "formats": ["ply"]}},
            "x: export: texture needs the format glb, not only ply; add it to formats",
        ),
        ({"export": {"texture_px": 20000}}, "x: export.texture_px: input should be less than"),
        ({"fit": {"degree": 5, "control_points": [4, 20]}}, "x: fit"),
    ],
)
def test_compose_invalid_option_raises_one_line(raw, message):
    with pytest.raises(ConfigError) as caught:
        compose(raw, "x")
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_compose_export_without_variants_takes_the_main_one():
    raw = {"variants": {"plane": {"fit": "plane"}, "smooth": {}}, "export": {"texture": True}}
    assert compose(raw, "x").export.variants == ("smooth",)


def test_load_config_unusable_file_raises(tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text("fit: {degree: 3")
    assert "bad.yaml: not readable as YAML" in refusal(bad)
    bad.write_text("- a\n- b\n")
    assert "expected a mapping" in refusal(bad)
    os.mkfifo(tmp_path / "pipe.yaml")
    for special in (tmp_path / "pipe.yaml", tmp_path):
        assert "is not a regular file; name a YAML file" in refusal(special)
    assert "File name too long" in refusal("a" * 5000)
    for name, meant in (("prod", "production"), ("papr", "paper")):
        assert refusal(name).endswith(f"neither a file nor a shipped name; did you mean {meant}?")


def refusal(path) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).isprintable()
    return str(caught.value)


def test_extends_reads_no_file_but_yaml_and_shows_nothing_of_it(tmp_path):
    mine = tmp_path / "mine.yaml"
    (tmp_path / "shadow").write_text("root:$6$hash: 1\n")
    (tmp_path / "link.yaml").symlink_to(tmp_path / "shadow")
    (tmp_path / "other.yaml").write_text("# not a configuration\npassword: hash\n")
    (tmp_path / "text.yaml").write_text("root:$6$hash\n")
    os.mkfifo(tmp_path / "pipe.yaml")
    for parent, message in {
        "shadow": "is not a YAML file; its name must end in .yaml or .yml",
        str(tmp_path / "shadow"): "is not a YAML file",
        "link.yaml": "is not a YAML file",
        "other.yaml": "other.yaml: line 2: the key is unknown in a configuration",
        "text.yaml": "text.yaml: expected a mapping of stages to options, but it is a text",
        "pipe.yaml": "is not a regular file",
        "missing.yaml": "neither a file nor a shipped name",
        '"a\\0b"': "neither a file nor a shipped name",
        "[paper]": "extends: expected a file or a shipped name, not ['paper']",
    }.items():
        mine.write_text(f"extends: {parent}\n")
        assert message in refusal(mine)
        assert "hash" not in refusal(mine)
        assert "password" not in refusal(mine)


def test_extends_endless_chain_raises(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("extends: mine.yaml\n")
    assert "the file extends itself" in refusal(mine)
    for number in range(20):
        (tmp_path / f"{number}.yaml").write_text(f"extends: {number + 1}.yaml\n")
    assert "more than 10 files extend each other" in refusal(tmp_path / "0.yaml")


def test_extends_merges_over_a_shipped_name_or_a_file_of_another_folder(tmp_path):
    (tmp_path / "city").mkdir()
    (tmp_path / "base.yml").write_text("extends: paper\nfit: {degree: 2}\nvariants: {flexroad: {}}\n")
    for parent in ("../base.yml", tmp_path / "base.yml"):
        (tmp_path / "city" / "mine.yaml").write_text(f"extends: {parent}\nload: {{halo_m: 5}}\n")
        config = load_config(tmp_path / "city" / "mine.yaml")
        assert list(config.chains) == ["flexroad"]
        chain = config.chains["flexroad"]
        assert (chain["fit"].degree, chain["fit"].learning_rate, chain["load"].halo_m) == (2, 0.1, 5)


HOSTILE = st.sampled_from(
    [
        None, True, -1, 10**99, 1e308, float("nan"), float("inf"), "", "x" * 5000, "\x1b[2J", "\ud800",
        "a\nb", "/", [], {}, [[]], {1: 2}, {"": None}, {None: 1}, {"method": []}, {"method": "plane"},
        {"method": "\x1b"}, b"x", ["flexroad"] * 100, {"\u202e": 1}, {f"k{n}": n for n in range(50)},
    ]
)  # fmt: skip
SEEDS = [
    {"fit": {"degree": 3, "control_points": [12, 12]}, "load": {"halo_m": 5}, "cluster": {"memory": "4 GiB"}},
    {
        "segment": {"method": "vector", "class_width_m": {"track": 3}},
        "ecsrc": "off",
        "export": {"formats": ["glb"]},
    },
    {"extends": "production", "variants": {"a": {"fit": "plane"}, "b": {"sample": {"road_m": 2}}}},
    {"dataset": {"layers": {"dsm": "{tile}.tif"}, "crs": "EPSG:25832"}, "cluster": "slurm", "fit": "nurbs"},
]


def changed(draw, value):
    """Return the value with one part replaced, added or removed."""
    if isinstance(value, dict | list) and value and draw(st.integers(0, 3)):
        keys = sorted(value) if isinstance(value, dict) else range(len(value))
        key = draw(st.sampled_from(list(keys)))
        copy = value.copy()
        copy[key] = changed(draw, value[key])
        if isinstance(value, dict) and draw(st.booleans()):
            copy[draw(st.sampled_from(["fit", "method", "", "\n", 1, None, "variants", "extends"]))] = draw(
                HOSTILE
            )
        return copy
    return draw(HOSTILE)


@given(st.data())
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_change_gives_a_configuration_or_lines(tmp_path, data):
    text = yaml.dump(changed(data.draw, data.draw(st.sampled_from(SEEDS)))).encode(errors="replace")
    if data.draw(st.booleans()):
        at = data.draw(st.integers(0, len(text)))
        text = text[:at] + data.draw(st.binary(max_size=4)) + text[at + data.draw(st.integers(0, 4)) :]
    path = tmp_path / "mine.yaml"
    path.write_bytes(text)
    try:
        config = load_config(path)
        Layout.of(config.dataset)
    except (ConfigError, CatalogError) as error:
        message = str(error)
    else:
        # As written to a run.
        message = str(compose(read_mapping(yaml.safe_dump(config.raw).encode(), "x"), "x").name)
    assert len(message) < 5000
    assert all(line.isprintable() for line in message.splitlines())


def test_template_is_production_with_every_option(tmp_path):
    (tmp_path / "mine.yaml").write_text(template())
    filled, production = load_config(tmp_path / "mine.yaml"), load_config("production")
    assert filled.chains == production.chains
    assert (filled.export, filled.cluster) == (production.export, production.cluster)
    raw = yaml.safe_load(template())
    assert raw.pop("extends") == "production"
    # Its values alone are complete, too.
    assert compose(raw, "x").chains == production.chains


def test_schema_contains_every_stage_and_option():
    properties = schema()["properties"]
    assert {"extends", "dataset", "export", "cluster", "variants", *STAGE_NAMES} == set(properties)
    assert "theta_z_m" in json.dumps(properties["ecsrc"])
    assert "control_points" in json.dumps(properties["fit"])


def test_setting_replaces_an_option_and_names_the_configuration():
    base, config = (
        load_config("production"),
        load_config("production", ["fit.spacing_m=5", "ecsrc.shoulder_m=2"]),
    )
    assert config.chains["flexroad"]["fit"].spacing_m == 5
    assert config.chains["flexroad"]["fit"].huber_m == base.chains["flexroad"]["fit"].huber_m
    assert config.raw["fit"]["spacing_m"] == 5
    assert config.name == "production --set fit.spacing_m=5 --set ecsrc.shoulder_m=2"
    # A variant with a method of its own keeps it.
    assert load_config("paper", ["fit.degree=2"]).chains["plane"]["fit"].method == "plane"


@pytest.mark.parametrize(
    "settings",
    [
        ["fit=smoothing_spline", "fit.spacing_m=5"],
        ["fit.spacing_m=5", "fit.method=smoothing_spline"],
        ["fit={method: smoothing_spline, spacing_m: 5}"],
        ["variants.flexroad.fit.spacing_m=5", "variants.flexroad.fit=smoothing_spline"],
    ],
)
def test_setting_of_a_method_starts_from_its_defaults(settings):
    fit = load_config("paper", settings).chains["flexroad"]["fit"]
    assert (fit.method, fit.spacing_m) == ("smoothing_spline", 5)


def test_setting_below_a_single_word_keeps_the_method():
    chains = load_config(
        "paper",
        ["variants.rgt.sample.method=corners", "segment.method=vector", "segment.class_width_m.track=9"],
    ).chains
    assert chains["rgt"]["sample"].method == "corners"
    assert chains["flexroad"]["segment"].method == "vector"
    assert chains["flexroad"]["segment"].class_width_m["track"] == 9


def test_settings_as_texts_and_as_dict_are_equal():
    texts = ["fit.spacing_m=5", "segment={method: vector, class_width_m: {track: 9}}", "export.formats=[npz]"]
    widths = {"method": "vector", "class_width_m": {"track": 9}}
    mapping = {"fit": {"spacing_m": 5}, "segment": widths, "export.formats": ("npz",)}
    one, other = (load_config("production", settings) for settings in (texts, mapping))
    chain = one.chains["flexroad"]
    assert (one.chains, one.export) == (other.chains, other.export)
    assert (chain["fit"].spacing_m, chain["fit"].huber_m, chain["fit"].bending_m3) == (5, 0.1, 30)
    assert chain["segment"].class_width_m["track"] == 9
    assert one.export.formats == ("npz",)
    config = load_config("production", {"ecsrc.shoulder_m": 1e-5, "fit": {"spacing_m": 5}})
    assert config.name == "production --set ecsrc.shoulder_m=1.0e-05 --set fit={spacing_m: 5}"
    assert config.chains["flexroad"]["ecsrc"].shoulder_m == 1e-5


def test_settings_with_a_value_that_is_not_yaml_raise():
    with pytest.raises(
        ConfigError, match="settings .* cannot represent an object; give numbers, texts or lists"
    ):
        load_config("production", {"fit.spacing_m": object()})


def test_setting_of_a_mapping_keeps_the_options_that_it_leaves_out():
    load = load_config("production", ["load={halo_m: 20}"]).chains["flexroad"]["load"]
    assert (load.halo_m, load.road_height) == (20, "auto")
    vector = ["segment={method: vector, class_width_m: {track: 9}}", "segment.class_width_m={service: 8}"]
    widths = load_config("production", vector).chains["flexroad"]["segment"].class_width_m
    assert (widths["track"], widths["service"]) == (9, 8)
    assert list(load_config("paper", ["variants={mine: {}}"]).chains) == ["mine"]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("fit.degre=2", "paper {}: fit.degre: unknown key; did you mean degree? valid are c"),
        ("ft.degree=2", "paper {}: ft: unknown key; did you mean fit? valid are load,"),
        ("fit.degree=99", "paper {}: fit.degree: input should be less than or equal to 10"),
        ("fit.degree.x=1", "--set fit.degree.x: fit.degree: expected a mapping of options, not 3"),
        ("fit.degree=[", "--set fit.degree: not readable as YAML"),
        ("fit.degree=" + "9" * 500, "--set fit.degree: not readable as YAML: line 1, column 1: a number of"),
        ("fit.degree", "--set 'fit.degree': give KEY=VALUE, like --set fit.spacing_m=5"),
        ("fit..degree=2", "--set 'fit..degree=2': give KEY=VALUE"),
        ("extends=production", "paper {}: extends: only files extend others, not 'production'"),
    ],
)
def test_invalid_setting_raises_one_line_that_names_it(setting, message):
    with pytest.raises(ConfigError) as caught:
        load_config("paper", [setting])
    assert str(caught.value).startswith(message.format(f"--set {setting}"))
    assert "\n" not in str(caught.value)
