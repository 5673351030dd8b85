"""The network: its parts against independent ones, its training, its checkpoint, and the surfaces it makes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'dense' is not installed")

from connrsfm_graph.dense.checkpoint import SHIPPED, Checkpoint, card_text  # noqa: E402
from connrsfm_graph.dense.choose import choose  # noqa: E402
from connrsfm_graph.dense.densify import densify  # noqa: E402
from connrsfm_graph.dense.encoders import DENSENET_169, DenseNet, ResNet50  # noqa: E402
from connrsfm_graph.dense.layout import DENSE_FOLDER, read_depth  # noqa: E402
from connrsfm_graph.dense.network import VARIANTS, make_network  # noqa: E402
from connrsfm_graph.dense.sparse import SparsePoints  # noqa: E402
from connrsfm_graph.dense.train import TrainConfig, held_out_error, train  # noqa: E402
from connrsfm_graph.errors import InputError  # noqa: E402
from tests.connrsfm_graph.dense.surface import SIZE, sheet, true_log_depth, write_images  # noqa: E402

TINY = TrainConfig(steps=4, batch=2, every=2, held_out=4)


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def shipped() -> Checkpoint:
    return Checkpoint.load(SHIPPED)


def test_encoders_have_the_published_sizes() -> None:
    """Parameters of torchvision's densenet169 and resnet50 without their classifiers (1664 x 1000 and 2048 x 1000)."""
    count = {encoder: sum(p.numel() for p in encoder.parameters()) for encoder in (DenseNet(*DENSENET_169), ResNet50())}
    assert list(count.values()) == [14_149_480 - 1_665_000, 25_557_032 - 2_049_000]
    for encoder, channels in zip(count, ([64, 64, 128, 256, 1664], [64, 256, 512, 1024, 2048]), strict=True):
        features = encoder.eval()(torch.zeros(1, 3, 64, 64))
        assert [f.shape[1] for f in features] == channels == encoder.channels
        assert [f.shape[2] for f in features] == [32, 16, 8, 4, 2]


@pytest.mark.parametrize("name", ["densenet169", "resnet50"])
def test_encoders_agree_with_torchvision(name: str) -> None:
    models = pytest.importorskip("torchvision.models", exc_type=Exception)  # another torch's fails in its own way
    torch.manual_seed(0)
    theirs = getattr(models, name)(weights=None).eval()
    ours = (DenseNet(*DENSENET_169) if name == "densenet169" else ResNet50()).eval()
    weights = [value for key, value in theirs.state_dict().items() if not key.startswith(("classifier", "fc"))]
    ours.load_state_dict(dict(zip(ours.state_dict(), weights, strict=True)))
    x = torch.randn(2, 3, 64, 64)
    if name == "densenet169":
        wanted = torch.relu(theirs.features(x))
    else:
        wanted = theirs.layer4(
            theirs.layer3(theirs.layer2(theirs.layer1(theirs.maxpool(theirs.relu(theirs.bn1(theirs.conv1(x)))))))
        )
    with torch.inference_mode():
        assert torch.allclose(ours(x)[-1], wanted, atol=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_answers_in_the_size_of_its_input(variant: str) -> None:
    network = make_network(variant, seed=0).eval()
    with torch.inference_mode():
        assert network(torch.zeros(2, 3, 64, 96)).shape == (2, 64, 96)
    decoder = [module for name, module in network.named_modules() if not name.startswith("encoder")]
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in decoder)


def test_training_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    whole = train(TINY, tmp_path / "whole.pt")

    def interrupt(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(TINY, tmp_path / "parts.pt", progress=interrupt)
    assert Checkpoint.load(tmp_path / "parts.pt").card["step"] == 2
    with pytest.raises(InputError, match="state of a training with other settings"):
        train(replace(TINY, seed=1), tmp_path / "parts.pt")
    seen: list[int] = []
    parts = train(TINY, tmp_path / "parts.pt", progress=lambda done, total: seen.append(done))
    assert seen == [3, 4], "steps 1 and 2 are not repeated"
    assert parts.card == whole.card
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, parts.network.state_dict()[name]), name
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "parts.md",
        "parts.pt",
        "whole.md",
        "whole.pt",
    ]


def test_training_lowers_the_error(tmp_path: Path) -> None:
    config = TrainConfig(steps=12, batch=8, every=12, held_out=16)
    start = held_out_error(make_network("compact", 0), config, 0.0)
    assert train(config, tmp_path / "a.pt").card["history"][-1]["clean"] < 0.95 * start


def test_a_checkpoint_keeps_its_answers(tmp_path: Path, shipped: Checkpoint) -> None:
    shipped.save(tmp_path / "copy.pt")
    copy = Checkpoint.load(tmp_path / "copy.pt")
    x = torch.randn(1, 3, 64, 64)
    with torch.inference_mode():
        assert torch.equal(copy.network(x), shipped.network(x))
    assert (copy.variant, copy.size, copy.card) == (shipped.variant, shipped.size, shipped.card)
    assert SHIPPED.stat().st_size < 3e6
    assert SHIPPED.with_suffix(".md").read_text() == card_text(shipped)


def test_wrong_checkpoints_are_one_sentence(tmp_path: Path, shipped: Checkpoint) -> None:
    cases = {
        "no such file": lambda file: None,
        "cannot be read as a checkpoint": lambda file: file.write_bytes(b"weights"),
        "cannot be read": lambda file: file.write_bytes(SHIPPED.read_bytes()[:5000]),
        "holds no dictionary": lambda file: torch.save([1, 2], file),
        "not a checkpoint of 'train-depth'": lambda file: torch.save({"state_dict": {}}, file),
        "weights are not those of the network 'resnet50'": lambda file: replace(shipped, variant="resnet50").save(file),
        "network 'unet' is unknown": lambda file: replace(shipped, variant="unet").save(file),
    }
    for number, (told, make) in enumerate(cases.items()):
        file = tmp_path / f"{number}.pt"
        make(file)
        with pytest.raises(InputError, match=told):
            Checkpoint.load(file)


def test_a_checkpoint_runs_no_code(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "sprung",)

    torch.save({"format": Trap()}, tmp_path / "a.pt")
    with pytest.raises(InputError, match="cannot be read as a checkpoint"):
        Checkpoint.load(tmp_path / "a.pt")
    assert not (tmp_path / "sprung").exists()


def test_the_shipped_network_holds_its_figures(shipped: Checkpoint) -> None:
    """Mean relative error of depth below 2 % on clean held-out surfaces, below 4 % with 20 % noise on the normals."""
    config = TrainConfig(held_out=64)
    assert held_out_error(shipped.network, config, 0.0) < 0.01
    assert held_out_error(shipped.network, config, 0.2) < 0.015


def test_the_network_makes_the_dense_surface(tmp_path: Path) -> None:
    true, images = sheet(), write_images(tmp_path / "images")
    index = densify(true, images, tmp_path, "network")
    assert (index.method, index.checkpoint) == ("network", "compact.pt")
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)
    for frame in index.frames:
        depth = read_depth(tmp_path / DENSE_FOLDER, frame)
        error = np.abs(depth / np.exp(true_log_depth(pixels, frame.frame)) - 1.0)
        assert np.nanmean(error) < 5e-4
        assert np.nanmax(error) < 5e-3
        assert frame.residual_percent < 0.05


def test_the_choice_says_why(shipped: Checkpoint) -> None:
    true = sheet()
    images = [SparsePoints.of(true, f) for f in range(true.n_frames)]
    choice = choose(images)
    assert choice.reason.startswith("cross-validated error of depth ")
    few = [SparsePoints.of(sheet(n_points=40), 0)]
    assert choose(few).reason == "an image has 40 points, the network was trained on 60 and more"
    assert choose(few, "network").warnings == (
        "the network may be wrong here: an image has 40 points, the network was trained on 60 and more",
    )
    steep = replace(images[0], normals=images[0].normals * [1.0, 1.0, 0.05])
    assert "surfaces are as steep as" in choose([steep]).reason
    assert choose([steep]).method.name == "spline"
