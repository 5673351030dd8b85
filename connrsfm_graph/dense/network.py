"""The network from an image of normals to depth: an encoder, a decoder, and features of equal size joined across.

The decoder has five blocks of convolutions with leaky ReLU and no batch normalisation. The first works on the encoder's
coarsest features; each further one doubles the size bilinearly and concatenates the encoder's features of that size. A
final block doubles to the input's size. All variants have the same interface: images of normals (B, 3, S, S) with S a
multiple of 32 to log depth (B, S, S) up to a constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import nn

from connrsfm_graph.dense.encoders import DENSENET_169, DenseNet, ResNet50
from connrsfm_graph.dense.window import Conditioned
from connrsfm_graph.errors import InputError

LEAK = 0.2
"""Slope of the leaky ReLU below zero."""


class DepthNetwork(nn.Module):
    """Log depth from an image of normals."""

    def __init__(self, encoder: DenseNet | ResNet50, widths: Sequence[int]) -> None:
        """Put a decoder with these channels per block, the final one included (six numbers), behind an encoder."""
        super().__init__()
        self.encoder = encoder
        skips = encoder.channels[-2::-1]
        self.bottom = _convolutions(encoder.channels[-1], widths[0])
        self.blocks = nn.ModuleList(
            _convolutions(width + skip, out) for width, skip, out in zip(widths[:4], skips, widths[1:5], strict=True)
        )
        self.final = nn.Sequential(
            nn.Conv2d(widths[4], widths[5], 3, padding=1), nn.LeakyReLU(LEAK), nn.Conv2d(widths[5], 1, 3, padding=1)
        )
        self.enlarge = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)

    def forward(self, normals: torch.Tensor) -> torch.Tensor:
        """(B, S, S) log depth of images of normals (B, 3, S, S)."""
        *skips, deepest = self.encoder(normals)
        x = self.bottom(deepest)
        for block, skip in zip(self.blocks, reversed(skips), strict=True):
            x = block(torch.cat([self.enlarge(x), skip], dim=1))
        return self.final(self.enlarge(x))[:, 0]


VARIANTS: dict[str, Callable[[], DepthNetwork]] = {
    "compact": lambda: DepthNetwork(DenseNet(16, (2, 3, 4, 3), 24), (96, 64, 48, 32, 16, 8)),
    "densenet169": lambda: DepthNetwork(DenseNet(*DENSENET_169), (512, 256, 128, 64, 32, 16)),
    "resnet50": lambda: DepthNetwork(ResNet50(), (512, 256, 128, 64, 32, 16)),
}
"""Networks by name."""


def make_network(variant: str, seed: int) -> DepthNetwork:
    """A network with random weights, the same for the same seed.

    Raises:
        InputError: no such variant.
    """
    if variant not in VARIANTS:
        raise InputError(f"network '{variant}' is unknown, expected one of {', '.join(VARIANTS)}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return VARIANTS[variant]()


def predict(network: DepthNetwork, images: np.ndarray, mask: np.ndarray, device: str = "cpu") -> np.ndarray:
    """Log depth (B, S, S) up to a constant from images of normals m (B, S, S, 3) on surfaces (B, S, S)."""
    conditioned = Conditioned.of(images, mask)
    network.eval()
    with torch.inference_mode():
        answer = network(tensor(conditioned.images, device))
    return conditioned.restored(answer.cpu().numpy())


def tensor(images: np.ndarray, device: str) -> torch.Tensor:
    """(B, 3, S, S) tensor of images (B, S, S, 3)."""
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))).to(device)


def _convolutions(width: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(width, out, 3, padding=1),
        nn.LeakyReLU(LEAK),
        nn.Conv2d(out, out, 3, padding=1),
        nn.LeakyReLU(LEAK),
    )
