"""Encoders of the depth network: DenseNet (Huang et al., CVPR 2017) and ResNet-50 (He et al., CVPR 2016).

Both take a three-channel image and return their features at a half, a quarter, ... and a thirty-second of its size. The
order of their parameters is that of torchvision's models, so that weights can be compared one to one.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

DENSENET_169 = (32, (6, 12, 32, 32), 64)
"""Growth rate, layers of each block, channels of the stem."""
RESNET_50 = (3, 4, 6, 3)
"""Bottlenecks of each stage."""


class DenseNet(nn.Module):
    """DenseNet-BC without its classifier: every layer sees all features that its block has made so far."""

    def __init__(self, growth: int, layers: Sequence[int], stem: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolution(3, stem, 7, stride=2), nn.BatchNorm2d(stem), nn.ReLU())
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        self.channels = [stem, stem]
        """Channels of the features at 1/2, 1/4, 1/8, 1/16 and 1/32."""
        stages: list[nn.Module] = []
        width = stem
        for number, count in enumerate(layers):
            block = nn.Sequential(*(_DenseLayer(width + i * growth, growth) for i in range(count)))
            width += count * growth
            if number + 1 < len(layers):
                stages.append(nn.Sequential(block, _transition(width)))
                width //= 2
                self.channels.append(width)
            else:  # the last block follows a transition without one of its own, at the same size
                stages[-1] = nn.Sequential(stages[-1], block, nn.BatchNorm2d(width), nn.ReLU())
                self.channels[-1] = width
        self.stages = nn.ModuleList(stages)

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Features of images (B, 3, H, W), finest first."""
        features = [self.stem(x)]
        features.append(self.pool(features[0]))
        for stage in self.stages:
            features.append(stage(features[-1]))
        return features


class ResNet50(nn.Module):
    """ResNet with bottlenecks, without its classifier."""

    def __init__(self, bottlenecks: Sequence[int] = RESNET_50) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolution(3, 64, 7, stride=2), nn.BatchNorm2d(64), nn.ReLU())
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        self.stages = nn.ModuleList()
        self.channels = [64]
        """Channels of the features at 1/2, 1/4, 1/8, 1/16 and 1/32."""
        width = 64
        for number, count in enumerate(bottlenecks):
            inner = 64 * 2**number
            stage = []
            for i in range(count):
                stage.append(_Bottleneck(width, inner, stride=2 if number and i == 0 else 1))
                width = 4 * inner
            self.stages.append(nn.Sequential(*stage))
            self.channels.append(width)

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Features of images (B, 3, H, W), finest first."""
        features = [self.stem(x)]
        deeper = self.pool(features[0])
        for stage in self.stages:
            deeper = stage(deeper)
            features.append(deeper)
        return features


class _DenseLayer(nn.Module):
    """Appends `growth` channels to its input, by way of a bottleneck of four times as many."""

    def __init__(self, width: int, growth: int) -> None:
        super().__init__()
        self.new = nn.Sequential(
            nn.BatchNorm2d(width),
            nn.ReLU(),
            _convolution(width, 4 * growth, 1),
            nn.BatchNorm2d(4 * growth),
            nn.ReLU(),
            _convolution(4 * growth, growth, 3),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat([x, self.new(x)], dim=1)


class _Bottleneck(nn.Module):
    """Three convolutions around which the input passes unchanged, or through one that fits its size."""

    def __init__(self, width: int, inner: int, stride: int) -> None:
        super().__init__()
        out = 4 * inner
        self.main = nn.Sequential(
            _convolution(width, inner, 1),
            nn.BatchNorm2d(inner),
            nn.ReLU(),
            _convolution(inner, inner, 3, stride),
            nn.BatchNorm2d(inner),
            nn.ReLU(),
            _convolution(inner, out, 1),
            nn.BatchNorm2d(out),
        )
        same = width == out and stride == 1
        self.around = nn.Identity() if same else nn.Sequential(_convolution(width, out, 1, stride), nn.BatchNorm2d(out))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.main(x) + self.around(x))


def _transition(width: int) -> nn.Sequential:
    """Half the channels at half the size."""
    return nn.Sequential(nn.BatchNorm2d(width), nn.ReLU(), _convolution(width, width // 2, 1), nn.AvgPool2d(2))


def _convolution(width: int, out: int, size: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(width, out, size, stride, padding=size // 2, bias=False)
