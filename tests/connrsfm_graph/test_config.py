"""Settings are typed, misspellings are met with the nearest name, and what is written reads back the same."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from connrsfm_graph.config import as_dict, as_toml, override, read_toml, setting_help, updated
from connrsfm_graph.errors import InputError


@dataclass(frozen=True)
class Inner:
    """A stage."""

    iterations: int = 10
    """How often."""
    weight: float = 0.5
    backend: Literal["batched", "gtsam"] = "batched"
    """Who computes;
    two lines."""
    pixel_sigma: float | None = None
    name: str = "joint"
    blocks: tuple[float, float, float] = (1.0, 0.1, 0.0)
    frames: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.iterations < 0:
            raise ValueError("iterations must be >= 0")


@dataclass(frozen=True)
class Outer:
    """The whole."""

    seed: int = 0
    robust: bool = True
    label: str | None = None
    solve: Inner = field(default_factory=Inner)
    warps: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    ("assignment", "stage", "value"),
    [
        ("solve.iterations=3", "iterations", 3),
        ("solve.weight=2", "weight", 2.0),
        ("solve.weight=1e-3", "weight", 1e-3),
        ("solve.weight=inf", "weight", float("inf")),
        ("solve.backend=gtsam", "backend", "gtsam"),
        ("solve.pixel_sigma=0.7", "pixel_sigma", 0.7),
        ("solve.pixel_sigma=none", "pixel_sigma", None),
        ("solve.name=5", "name", "5"),
        ('solve.name="a=b"', "name", "a=b"),
        ("solve.blocks=1,2,3", "blocks", (1.0, 2.0, 3.0)),
        ("solve.blocks=[1, 2.5, 3]", "blocks", (1.0, 2.5, 3.0)),
        ("solve.frames=4", "frames", (4,)),
        ("solve.frames=[]", "frames", ()),
    ],
)
def test_override(assignment: str, stage: str, value: object) -> None:
    config = override(Outer(), [assignment])
    found = getattr(config.solve, stage)
    assert found == value
    assert type(found) is type(value)
    assert config.warps == Inner()


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("solve.iteration=3", r"--set solve\.iteration: no such setting; did you mean solve\.iterations\?"),
        ("slove.iterations=3", r"slove: no such setting; did you mean solve\?"),
        ("zzz=3", "expected one of seed, robust, label, solve, warps"),
        ("solve.iterations=2.5", r"solve\.iterations: 2\.5 is not a whole number"),
        ("solve.iterations=true", "true is not a whole number"),
        ("solve.weight=heavy", "heavy is not a number"),
        ("solve.weight=nan", "nan is not a number"),
        ("robust=1", "robust: 1 is not true or false"),
        ("solve.backend=ceres", "ceres is not one of batched, gtsam"),
        ("solve.pixel_sigma=small", "small is not a number or none"),
        ("solve.blocks=1,2", r"1,2 is not a list of 3 \(a number, a number, a number\)"),
        ("solve=3", r"solve: is a group of settings; set one of solve\.iterations"),
        ("solve.iterations.deep=3", "is not a whole number"),
        ("solve.iterations=-1", "solve: iterations must be >= 0"),
        ("solve.iterations", "expected key=value"),
    ],
)
def test_bad_override_is_named(assignment: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        override(Outer(), [assignment])


def test_file_then_override(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text('seed = 4\n[solve]\nbackend = "gtsam"\nweight = 1\n')
    config = override(read_toml(Outer(), path), ["seed=5", "seed=6"])
    assert config == Outer(seed=6, solve=Inner(backend="gtsam", weight=1.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = ", "not a TOML file"),
        ("[solve]\nitertions = 1", r"run\.toml: solve\.itertions: .* mean solve\.iterations"),
    ],
)
def test_bad_file_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_toml(Outer(), path)
    with pytest.raises(InputError, match="no such file"):
        read_toml(Outer(), tmp_path / "absent.toml")


plain_text = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]))
inner = st.builds(
    Inner,
    iterations=st.integers(0, 10**9),
    weight=st.floats(allow_nan=False),
    backend=st.sampled_from(["batched", "gtsam"]),
    pixel_sigma=st.none() | st.floats(allow_nan=False),
    name=plain_text,
    blocks=st.tuples(*[st.floats(allow_nan=False)] * 3),
    frames=st.lists(st.integers(-5, 5)).map(tuple),
)
label = st.none() | plain_text.filter(lambda text: text.lower() != "none")


@given(st.builds(Outer, seed=st.integers(0, 99), robust=st.booleans(), label=label, solve=inner, warps=inner))
def test_written_configuration_reads_back(config: Outer) -> None:
    read: dict[str, Any] = tomllib.loads(as_toml(config))
    assert updated(Outer(), read) == config
    assert updated(Outer(), as_dict(config)) == config


def test_help_is_the_string_below_the_field() -> None:
    assert setting_help(Inner) == {"iterations": "How often.", "backend": "Who computes;\ntwo lines."}
    assert "# Who computes; two lines.\nbackend" in as_toml(Outer())


def test_settings_without_source_have_no_help_but_work() -> None:
    made = make_dataclass("Made", [("weight", float, field(default=0.5))], frozen=True)()
    assert setting_help(type(made)) == {}
    assert as_toml(override(made, ["weight=2"])) == "weight = 2.0\n"
