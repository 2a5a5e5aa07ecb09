import json

import pytest
import yaml

from flexroad.pipeline.config.loading import compose, load_config, shipped
from flexroad.pipeline.config.schema import schema, template
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.filter import planar


def test_shipped_configurations_are_valid():
    assert {"paper", "nightly"} <= set(shipped())
    for name in shipped():
        assert load_config(name).chains


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
        "variants": {"a": {"fit": {"iterations": 7}}, "b": {"fit": "plane"}, "c": None},
    }
    chains = compose(raw, "x").chains
    assert (chains["a"]["fit"].degree, chains["a"]["fit"].iterations) == (5, 7)
    assert chains["b"]["fit"].method == "plane"
    assert chains["c"]["fit"].degree == 5


def test_extends_merges_over_parent(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("extends: paper\nfit: {degree: 2}\nvariants: {flexroad: {}}\n")
    config = load_config(path)
    assert list(config.chains) == ["flexroad"]
    assert config.chains["flexroad"]["fit"].degree == 2
    assert config.chains["flexroad"]["fit"].learning_rate == 0.1


def test_override_with_other_filter_uses_its_defaults(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("extends: paper\necsrc: planar\nvariants: {flexroad: {}, bare: {ecsrc: off}}\n")
    chains = load_config(path).chains
    assert chains["flexroad"]["ecsrc"] == planar.Options()
    assert chains["bare"]["ecsrc"] == load_config("ablation").chains["wo_ecsrc"]["ecsrc"]


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"ecrsc": {}}, "x: ecrsc: unknown key; did you mean ecsrc?"),
        ({"ecsrc": {"theta_z": 0.5}}, "x: ecsrc.theta_z: unknown key; did you mean theta_z_m?"),
        ({"segment": {"method": "vector", "wher": ""}}, "x: segment.wher: unknown key; did you mean where?"),
        ({"fit": {"degre": 2}}, "x: fit.degre: unknown key; did you mean degree?"),
        ({"ecsrc": {"theta_z_m": -1}}, "x: ecsrc.theta_z_m: input should be greater than"),
        ({"ecsrc": {"method": "planar", "bend": 0}}, "x: ecsrc.bend: input should be greater than"),
        ({"fit": {"degree": "three"}}, "x: fit.degree: input should be a valid integer"),
        ({"fit": "nurb"}, "x: fit: "),
        (
            {"segment": {"method": "vector", "cleanup": {"drop_m": 3}}},
            "x: segment.cleanup.drop_m: unknown key; did you mean drop_m2?",
        ),
        (
            {"fit": {"huber_m": 0.1}},
            "x: fit.huber_m: unknown key; it is an option of method smoothing_spline, not of nurbs",
        ),
        ({"ecsrc": {"variant": "off"}}, "x: ecsrc.variant: unknown key; it is called method"),
        ({"ecsrc": "grounded"}, "x: ecsrc: there is no method 'grounded'; it is called planar"),
        ({"fit": {"solver": "irls"}}, "x: fit.solver: unknown key; the solver is a method of its own"),
        (
            {"segment": {"method": "vector", "hygiene": {}}},
            "x: segment.hygiene: unknown key; it is called cleanup",
        ),
        ({"fit": [1]}, "x: fit: expected a mapping of options, not [1]"),
        ({"variants": {"a": {"fitt": {}}}}, "x: variants.a.fitt: unknown key; did you mean fit?"),
        ({"variants": {"a": {"sample": {"road": 1}}}}, "x: variants.a.sample.road: unknown key"),
        ({"variants": ["a"]}, "x: variants: expected a mapping"),
        ({"export": {"variants": ["b"]}}, "x: export.variants: no variant 'b', only flexroad"),
        ({"fit": {"degree": 5, "control_points": [4, 20]}}, "x: fit"),
    ],
)
def test_compose_invalid_option_raises_one_line(raw, message):
    with pytest.raises(ConfigError) as caught:
        compose(raw, "x")
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_load_config_unusable_file_raises(tmp_path):
    with pytest.raises(ConfigError, match="did you mean paper"):
        load_config("papr")
    bad = tmp_path / "bad.yaml"
    bad.write_text("fit: {degree: 3")
    with pytest.raises(ConfigError, match=r"bad.yaml: not readable as YAML"):
        load_config(bad)
    bad.write_text("- a\n- b\n")
    with pytest.raises(ConfigError, match="expected a mapping"):
        load_config(bad)


def test_template_equals_default_configuration():
    raw = yaml.safe_load(template())
    filled, empty = compose(raw, "x"), compose({}, "x")
    assert filled.chains == empty.chains
    assert filled.export == empty.export


def test_schema_contains_every_stage_and_option():
    properties = schema()["properties"]
    assert list(properties) == [
        "extends", "dataset", "load", "segment", "ecsrc", "fit", "sample", "evaluate", "assess", "export",
        "cluster", "variants",
    ]  # fmt: skip
    assert "theta_z_m" in json.dumps(properties["ecsrc"])
    assert "control_points" in json.dumps(properties["fit"])
