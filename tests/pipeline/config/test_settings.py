import pytest

from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError


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
