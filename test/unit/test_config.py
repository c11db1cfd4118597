"""Configuration: defaults, both YAML styles, and the messages of refusals."""

from __future__ import annotations

import dataclasses

import pytest
from paths import FORMER_OPTIONS, FORMER_VERSION, ROOT

from calib_ros.config import Config, ImageConfig, OnlineConfig, SearchConfig, stages, update
from calib_ros.config.removed import REMOVED
from calib_ros.errors import BadInputError, ConfigError

FIELDS = [(stage, f) for stage, cls in stages().items() for f in dataclasses.fields(cls)]
NUMBERS = [(stage, f) for stage, f in FIELDS if f.metadata["low"] is not None]


@pytest.fixture
def read(tmp_path):
    def read(text: str | bytes) -> Config:
        path = tmp_path / "config.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return Config.from_yaml(path)

    return read


def test_every_field_has_a_meaning_every_number_a_range_and_the_shipped_files_the_defaults():
    assert Config.from_yaml(ROOT / "config" / "calib_ros.yaml") == Config()
    assert Config.from_yaml(ROOT / "config" / "vehicle.yaml") == Config()
    for stage, f in FIELDS:
        assert f.metadata["doc"], f"{stage}.{f.name}"
        number = isinstance(f.default[0] if isinstance(f.default, tuple) else f.default, (int, float))
        if number and not isinstance(f.default, bool):
            assert f.metadata["low"] < f.metadata["high"], f"{stage}.{f.name}"


def test_both_ends_of_a_range_are_allowed_and_no_more():
    def set_to(stage, f, v):
        # Of the stage alone: two values that contradict each other are another test's.
        tuple_ = isinstance(f.default, tuple)
        return getattr(stages()[stage](**{f.name: [v] * len(f.default) if tuple_ else v}), f.name)

    for stage, f in NUMBERS:
        low, high = f.metadata["low"], f.metadata["high"]
        for bound in (low, high):
            assert set_to(stage, f, bound) == ((bound,) * len(f.default) if isinstance(f.default, tuple) else bound), f.name
        for wrong in (low - 1, high + 1):
            with pytest.raises(ConfigError) as caught:
                set_to(stage, f, wrong)
            assert str(caught.value) == f"{stage}.{f.name} = {wrong!r} is out of range [{low:g}, {high:g}]"


def test_values_that_contradict_each_other_are_refused():
    for values, text in (
        ({"online": {"min_keyframes": 21}}, "min_keyframes = 21 is more than online.buffer_size = 20"),
        ({"online": {"min_keyframes": 2, "buffer_size": 1}}, "no estimate"),
        ({"refine": {"objective": "thesis", "optimizer": "levenberg_marquardt"}}, "levenberg_marquardt needs a gradient"),
        ({"semantics": {"segment_anything_decoder": "decoder.onnx"}}, "segment_anything_decoder is set without"),
    ):
        with pytest.raises(ConfigError, match=text):
            Config.from_dict(values)


@pytest.mark.parametrize(
    "text",
    [
        "search: {seed: 4, rotation_deg: 5}\nonline: {mode: manual}",
        "/**:\n  ros__parameters:\n    search.seed: 4\n    search.rotation_deg: 5.0\n    online.mode: manual",
        "node:\n  ros__parameters:\n    search:\n      seed: 4\n      rotation_deg: 5.0\n    online: {mode: manual}",
        "/**:\n ros__parameters:\n  search: {seed: 4}\n  search.rotation_deg: 5\n  online.mode: manual\n  publish_tf: 1",
        "\ufeffsearch: {seed: 4.0, rotation_deg: 5}\nonline: {mode: manual}",
    ],
    ids=["stages", "ros flat", "ros nested", "ros mixed", "byte order mark"],
)
def test_yaml_styles_mean_the_same(read, text):
    config = read(text)
    assert config == update(Config(), {"search": {"seed": 4, "rotation_deg": 5.0}, "online": {"mode": "manual"}})
    assert isinstance(config.search.rotation_deg, float)
    assert isinstance(config.search.seed, int)


@pytest.mark.parametrize("text", ["", "# nothing\n", "---\n", "/**:\n  ros__parameters:\n", "{}", "search: {}", "search:\n"])
def test_empty_files_mean_the_defaults(read, text):
    assert read(text) == Config()


def test_wrong_values_are_refused_by_name(read):
    for text, says in (
        ("serch: {seed: 1}", "stage 'serch'; there are camera, image, lidar, "),
        ("search: {sed: 1}", "unknown parameter 'search.sed'; there are .*seed"),
        ("/**:\n  ros__parameters:\n    search.sed: 1", "unknown parameter 'search.sed'"),
        ("search: 5", "stage 'search' must hold names and values, got 5"),
        ("search: {seed: 1.5}", "search.seed = 1.5 must be of type int"),
        ("search: {seed: true}", "search.seed = True must be of type int"),
        ("search: {rotation_deg: '3'}", "search.rotation_deg = '3' must be of type float"),
        ("search: {rotation_deg: 46}", r"search.rotation_deg = 46 is out of range \[0, 45\]"),
        ("search: {rotation_deg: .nan}", r"search.rotation_deg = nan is out of range"),
        ("monitor: {enabled: 'true'}", "monitor.enabled = 'true' must be of type bool"),
        ("refine: {optimizer: bfgs}", "optimizer = 'bfgs' must be one of auto, levenberg_marquardt, nelder_mead"),
        ("lidar: {ego_box: 4}", "lidar.ego_box = 4 must be a list of float"),
        ("constraints: {limit_m: [0, 0]}", r"constraints.limit_m = \[0, 0\] must have 3 elements"),
        ("constraints: {sigma_deg: [1, 1, -0.1]}", r"constraints.sigma_deg = -0.1 is out of range \[0, 180\]"),
    ):
        with pytest.raises(ConfigError, match=says) as caught:
            read(text)
        assert "\n" not in str(caught.value)


def test_files_without_a_configuration_are_refused(read, tmp_path):
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(BadInputError, match="cannot read configuration"):
            Config.from_yaml(path)
    for text, says in (
        ("search: {seed: 1\nonline: [", "line [23]"),
        ("search:\n\tseed: 1", "line 2"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
        (b"\xff\xfe\x00abc", "not valid YAML"),
        ("- search", "must hold stages"),
        ("/**:\n  ros__parameters: [1, 2]", "must hold names and values"),
    ):
        with pytest.raises(BadInputError, match=says) as caught:
            read(text)
        assert "config.yaml" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_update_changes_what_is_named_and_nothing_else_and_dictionaries_keep_everything():
    config = Config(image=ImageConfig(max_width=640), search=SearchConfig(seed=7), online=OnlineConfig(mode="manual"))
    assert Config.from_dict(config.to_dict()) == config != Config()
    base = Config(search=SearchConfig(seed=3, starts=64))
    changed = update(base, {"search": {"starts": 32}, "constraints": {"sigma_m": [1, 2, 3]}})
    assert (changed.search.seed, changed.search.starts) == (3, 32)
    assert changed.constraints.sigma_m == (1.0, 2.0, 3.0)
    assert base.search.starts == 64
    assert (changed.image, changed.online) == (base.image, base.online)


FORMS = ["{stage}: {{{name}: {value}}}", "/**:\n  ros__parameters:\n    {stage}.{name}: {value}"]


@pytest.mark.parametrize("form", FORMS)
def test_removed_options_are_ignored_with_one_warning(read, form):
    with pytest.warns(FutureWarning, match=r"^lidar\.jump_min has no effect any more; remove it$") as caught:
        assert read(form.format(stage="lidar", name="jump_min", value="[a]")) == Config()
    assert len(caught) == 1
    with pytest.warns(FutureWarning, match=r"; in place of semantics\.first_guess there is initial\.method: semantic$"):
        Config.from_dict({"semantics": {"first_guess": True, "witness": False}})
    with pytest.raises(ConfigError, match=r"unknown parameter 'guess\.tilt'"):
        Config.from_dict({"guess": {"tilt": 30.0}})


def test_all_removed_options_at_once_make_one_warning_a_stage():
    assert not REMOVED & {f"{stage}.{f.name}" for stage, f in FIELDS}
    values: dict[str, dict[str, object]] = {}
    for option in REMOVED:
        stage, _, name = option.partition(".")
        values.setdefault(stage, {})[name] = 1
    with pytest.warns(FutureWarning, match="no effect any more; remove") as caught:
        assert Config.from_dict(values) == Config()
    assert len(caught) == len(values)
    assert all(name in "".join(str(w.message) for w in caught) for name in REMOVED)


def test_configurations_of_former_versions_still_load():
    """As ~/capture of calib_node wrote it beside a bag; and the shipped one of 187 options, one of whose defaults has changed."""
    with pytest.warns(FutureWarning, match="no effect any more"):
        former = Config.from_yaml(FORMER_OPTIONS / "config.yaml")
    assert former == update(Config(), {"camera": {"focal_sigma": 0.003}})
    with pytest.warns(FutureWarning) as caught:
        config = Config.from_yaml(FORMER_VERSION / "config.yaml")
    told = [str(w.message) for w in caught]
    for name in ("tracker.drift_deg", "semantics.witness", "search.distinct", "search.climbed", "search.refined"):
        assert sum(name in text and "no effect any more" in text for text in told) == 1
    assert config == Config.from_dict(
        {"online": {"pair_tolerance_s": 0.05, "max_load": 1.0}, "search": {"seed": 7, "rounds": 8, "starts": 2048}}
    )
